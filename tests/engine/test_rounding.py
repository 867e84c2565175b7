"""The fuzzer's comparison accepts differences that rounding explains, and no others."""

import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from rounding import TINY, are_within_rounding

NAN = np.nan
DENORMAL = 2.0**-130


def is_within_rounding(fn, values, computed, dtype=np.float32):
    """Return True if ``computed`` is the result of a function for the values of one lane, within rounding."""
    arrays = [np.asarray([x], None if isinstance(x, int) else np.float32) for x in values]
    arrays = [x.astype(np.int32) if x.dtype.kind == "i" else x for x in arrays]
    return bool(are_within_rounding(fn, arrays, np.asarray([computed], dtype), signed=False)[0])


@pytest.mark.parametrize(
    ("fn", "values", "computed", "wrong"),
    [
        pytest.param(lax.lgamma, [1.4891759], -0.12112227, -0.1212, id="lgamma between its zeros"),
        pytest.param(lax.digamma, [1.5], 0.036489975, 0.0366, id="digamma near its zero"),
        pytest.param(lambda x, y, z: x * y + z, [2e20, 2e18, -2e38], 2e38, None, id="overflow before a sum"),
        pytest.param(lambda x, y, z: x * y + z, [2e10, 2e8, -2e18], 2e18, 2.1e18, id="a sum of ordinary numbers"),
        pytest.param(lambda x, y: x @ y, [[2e20, 1e20], [2e18, -2e18]], 2e38, None, id="overflow in a scalar product"),
        pytest.param(lambda x: lax.cumprod(x), [[1e30, 1e-30, 1e-30]], [1e30, 1.0, 0.0], [1.0, 1.0, 0.0], id="cumprod"),
        pytest.param(lambda x: jnp.prod(x), [[TINY, 1e-3, 1e30]], 1.1754944e-11, None, id="a product that vanishes"),
        pytest.param(lambda x: jnp.prod(x), [[2.0, 3.0, 4.0]], 24.0, 25.0, id="a product of ordinary numbers"),
        pytest.param(lambda x: jnp.sum(x), [[3e38, 3e38, -3e38]], 3e38, None, id="a sum that overflows"),
        pytest.param(lax.rem, [3.0, DENORMAL], NAN, 1.0, id="remainder by a denormal number taken for zero"),
        pytest.param(lax.rem, [3.0, DENORMAL], 0.0, 1.0, id="remainder by a denormal number"),
        pytest.param(lax.pow, [0.0, DENORMAL], 1.0, 2.5, id="power with a denormal exponent taken for zero"),
        pytest.param(lax.rem, [3.0, 2.0], 1.0, NAN, id="remainder by an ordinary number"),
        pytest.param(lax.div, [0.0, DENORMAL], NAN, None, id="division by a denormal number taken for zero"),
        pytest.param(lax.div, [0.0, DENORMAL], 0.0, None, id="division by a denormal number"),
    ],
)
def test_rounding_is_distinguished_from_wrong_results(fn, values, computed, wrong):
    """Rounding must not explain ``wrong``, which is None where any number is possible."""
    assert is_within_rounding(fn, values, computed)
    assert wrong is None or not is_within_rounding(fn, values, wrong)


def test_the_sign_of_zero_is_kept_where_it_is_defined():
    values, result = [np.float32([-0.0])], np.float32([0.0])
    assert are_within_rounding(jnp.rint, values, -result, signed=True)[0]
    assert not are_within_rounding(jnp.rint, values, result, signed=True)[0]


def test_zero_by_zero_is_any_integer_that_compilers_make_of_it():
    for result in (-1, 1):
        assert is_within_rounding(lax.div, [0, 0], result, np.int32)
    assert not is_within_rounding(lax.div, [0, 0], 7, np.int32)
    assert not is_within_rounding(lax.div, [5, 0], 1, np.int32)
