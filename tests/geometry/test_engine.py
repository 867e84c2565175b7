"""A distance inside a step gives the same numbers on every engine."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import FAST, shared_sim
from oracle import SHAPES

from crazysim import rotation
from crazysim.core.stage import stage
from crazysim.engine import Step
from crazysim.geometry import Shape, distance, hull

SPHERE = Shape("sphere", (0.1,))
BODIES = SHAPES | {"mesh": hull([[0.4, 0, 0], [-0.3, 0.3, 0], [-0.2, -0.4, 0.1], [0, 0.1, 0.5], [0.1, 0, -0.3]])}


def watched(a, kinds):
    """Return a simulation whose drones, of shape ``a``, have as their force the distances to three shapes."""
    sim = shared_sim(n_worlds=7, n_drones=3, control="rotor_vel")

    @stage("drone")
    def watch(data):
        s = data.states
        found = [distance(a, BODIES[kind], s.pos, rotation.matrix(s.quat)) for kind in kinds]
        slope = jax.grad(lambda p: distance(a, BODIES[kinds[0]], p, rotation.matrix(s.quat)))(s.pos)
        return data.replace(states=s.replace(force=jnp.stack(found), torque=slope))

    rng = np.random.default_rng(3)
    quat = rng.normal(size=(7, 3, 4))
    states = sim.data.states.replace(
        pos=jnp.asarray(rng.uniform(-0.6, 0.6, (7, 3, 3)), jnp.float32),
        quat=jnp.asarray(quat / np.linalg.norm(quat, axis=-1, keepdims=True), jnp.float32),
    )
    return sim.step_pipeline | {"watch": watch}, sim.data.replace(states=states)


@pytest.mark.parametrize("a, kinds", [
    (SPHERE, ("plane", "sphere", "capsule")), (SPHERE, ("ellipsoid", "box", "cylinder")),
    (SPHERE, ("mesh", "plane", "plane")),
])  # fmt: skip
def test_engines_agree(a, kinds):
    pipeline, data = watched(a, kinds)
    expected = Step(pipeline, "plain")(data, jnp.int32(1)).states
    assert np.sum(np.asarray(expected.force) < 0) > 3
    assert np.sum(np.asarray(expected.force) > 0) > 3
    for engine in FAST:
        step = Step(pipeline, engine)
        assert step.plan(data).engine == engine
        found = step(data, jnp.int32(1)).states
        np.testing.assert_allclose(found.force, expected.force, atol=2e-6)
        np.testing.assert_allclose(found.torque, expected.torque, atol=1e-4)
