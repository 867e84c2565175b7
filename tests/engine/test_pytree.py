"""Records: frozen, registered, and with the axes of every leaf declared."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from crazysim import ConfigError, PyTree, leaf, static
from crazysim.engine.pytree import check_axes, map_batched, scopes, select_worlds


class Rotor(PyTree):
    speed: jax.Array = leaf("drone", 1)
    curve: jax.Array = leaf("parameter", 1)


class Fleet(PyTree):
    rotor: Rotor
    time: jax.Array = leaf("world")
    wind: jax.Array = leaf("shared", 1)
    table: jax.Array = leaf("opaque")
    spare: Rotor | None
    extras: dict
    rate: int = static()


def fleet(n_worlds=3, n_drones=2, rate=50, curve=None):
    rotor = Rotor(jnp.ones((n_worlds, n_drones, 4)), jnp.ones(3) if curve is None else curve)
    extras = {"bare": jnp.ones(n_worlds), "record": Rotor(jnp.zeros((n_worlds, n_drones, 1)), jnp.zeros(1))}
    return Fleet(rotor, jnp.zeros((n_worlds, 1)), jnp.zeros(3), jnp.zeros((n_worlds, 7)), None, extras, rate)


def test_static_fields_are_part_of_the_type_and_arrays_are_leaves():
    assert jax.tree.structure(fleet()) == jax.tree.structure(fleet())
    assert jax.tree.structure(fleet(rate=100)) != jax.tree.structure(fleet())
    assert (
        len(jax.tree.leaves(fleet())) == 2 + 3 + 3
    )  # rotor, time, wind and table, extras; None and the rate are no leaves


def test_law_02_scopes_are_declared_and_undeclared_means_whole():
    declared = scopes(fleet())
    assert (declared.time, declared.wind, declared.table) == ("world", "shared", "opaque")
    assert (declared.rotor.speed, declared.rotor.curve) == ("drone", "shared")
    assert declared.extras["bare"] == "opaque"
    assert declared.extras["record"].speed == "drone"
    assert declared.spare is None
    assert scopes({"list": [jnp.ones(3), Rotor(jnp.ones(1), jnp.ones(1))]})["list"][1].speed == "drone"


def test_law_02_a_parameter_is_shared_or_drone_by_its_dimensions():
    assert scopes(fleet(3, 3, curve=jnp.ones(3))).rotor.curve == "shared"
    assert scopes(fleet(3, 3, curve=jnp.ones((3, 3, 3)))).rotor.curve == "drone"


@pytest.mark.parametrize(
    "change",
    [
        lambda f: f.replace(time=jnp.zeros(3)),
        lambda f: f.replace(time=jnp.zeros((3, 2))),
        lambda f: f.replace(wind=jnp.zeros((3, 2, 3))),
        lambda f: f.replace(rotor=f.rotor.replace(speed=jnp.zeros((2, 3, 4)))),
        lambda f: f.replace(rotor=f.rotor.replace(curve=jnp.zeros((3, 3)))),
        lambda f: f.replace(rotor=f.rotor.replace(curve=jnp.zeros((3, 1, 3)))),
        lambda f: f.replace(extras={"record": f.rotor.replace(speed=jnp.zeros(4))}),
    ],
)
def test_law_02_a_leaf_with_other_axes_is_refused_by_name(change):
    check_axes(fleet(), 3, 2)
    with pytest.raises(ConfigError, match=r"data\.(time|wind|rotor\.|extras\['record'\]\.speed).*has shape"):
        check_axes(change(fleet()), 3, 2)


def test_map_batched_changes_leaves_of_drones_and_worlds_only():
    old = fleet(curve=jnp.ones((3, 2, 3)))
    new = map_batched(lambda x: x + 5, old)
    changed = [bool(jnp.any(a != b)) for a, b in zip(jax.tree.leaves(old), jax.tree.leaves(new), strict=True)]
    is_batched = [scope in ("drone", "world") for scope in jax.tree.leaves(scopes(old))]
    assert changed == is_batched
    assert sum(is_batched) == 4


@given(n_worlds=st.integers(1, 4), n_drones=st.integers(1, 4), data=st.data())
def test_select_worlds_takes_the_new_value_where_the_mask_says(n_worlds, n_drones, data):
    mask = np.array(data.draw(st.lists(st.booleans(), min_size=n_worlds, max_size=n_worlds)))
    old = np.arange(n_worlds * n_drones * 2.0).reshape(n_worlds, n_drones, 2)
    expected = np.where(mask[:, None, None], -1.0 - old, old)
    for shape in ((n_worlds,), (n_worlds, 1)):
        np.testing.assert_array_equal(select_worlds(jnp.asarray(mask.reshape(shape)), -1.0 - old, old), expected)
