import math
import re

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from difflpv.parameters import Parameter

LAW = settings(deadline=None, max_examples=30)
FLOATS = st.floats(-1e6, 1e6, allow_nan=False, allow_infinity=False)
SHARES = st.floats(1e-9, 1.0 - 1e-9)


def make(lower, upper, shares, scale=None):
    """A parameter of one entry per share, at those shares of its interval, or at those distances from its bound."""
    shares = torch.tensor(shares, dtype=torch.float64)
    if math.isfinite(lower) and math.isfinite(upper):
        initial = lower + (upper - lower) * shares
    elif math.isfinite(lower):
        initial = lower + shares * 100
    elif math.isfinite(upper):
        initial = upper - shares * 100
    else:
        initial = (shares - 0.5) * 100
    return Parameter("x", initial, lower, upper, scale)


BOUNDS = [(0.0, 1.0), (-3.0, 1e4), (0.0, math.inf), (-5.0, math.inf), (-math.inf, 2.0), (-math.inf, math.inf)]


@pytest.mark.parametrize("bounds", BOUNDS)
@LAW
@given(shares=st.lists(SHARES, min_size=1, max_size=5))
def test_round_trip_from_physical(bounds, shares):
    p = make(*bounds, [max(s, 1e-6) for s in shares])
    back = p.to_physical(p.to_raw(p.initial))
    width = (p.upper - p.lower).clamp(max=100.0).max()
    torch.testing.assert_close(back, p.initial, rtol=1e-12, atol=1e-13 * float(width))


@pytest.mark.parametrize("bounds", [(0.0, 1.0), (0.0, math.inf), (-math.inf, 0.0), (-math.inf, math.inf)])
@LAW
@given(raw=st.lists(st.floats(-30, 30), min_size=1, max_size=4))
def test_round_trip_from_raw(bounds, raw):
    p = make(*bounds, [0.4] * len(raw))
    raw = torch.tensor(raw, dtype=torch.float64)
    # Next to an upper bound of 1 the spacing of float64 limits the inverse: 1.1e-16 e^r.
    torch.testing.assert_close(p.to_raw(p.to_physical(raw.clamp(max=12))), raw.clamp(max=12), rtol=1e-9, atol=1e-9)


@LAW
@given(raw=st.floats(allow_nan=False, allow_infinity=False, width=64), low=FLOATS, width=st.floats(1e-3, 1e6))
def test_never_outside_its_bounds(raw, low, width):
    p = make(low, low + width, [0.5])
    x = p.to_physical(torch.tensor([raw], dtype=torch.float64))
    assert p.lower <= x <= p.upper


@LAW
@given(raw=st.floats(-1e3, 1e3))
def test_half_lines_stay_on_their_side(raw):
    raw = torch.tensor([raw], dtype=torch.float64)
    assert make(2.0, math.inf, [0.1]).to_physical(raw) >= 2.0
    assert make(-math.inf, 2.0, [0.1]).to_physical(raw) <= 2.0


def test_softplus_is_exact_beyond_torchs_threshold():
    p = Parameter("x", [1.0], 0.0, scale=1.0)
    raw = torch.tensor([21.0], dtype=torch.float64)
    assert float(p.to_physical(raw) - raw) == pytest.approx(math.log1p(math.exp(-21)), rel=1e-4)


@pytest.mark.parametrize("bounds", BOUNDS)
@LAW
@given(raw=st.lists(st.floats(-8, 8), min_size=1, max_size=3))
def test_gradcheck_and_increasing(bounds, raw):
    p = make(*bounds, [0.3] * len(raw))
    raw = torch.tensor(raw, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(p.to_physical, (raw,))
    (slope,) = torch.autograd.grad(p.to_physical(raw).sum(), raw)
    assert (slope > 0).all()


def test_gradient_is_finite_far_out():
    for bounds in BOUNDS:
        p = make(*bounds, [0.3, 0.3])
        raw = torch.tensor([-800.0, 800.0], dtype=torch.float64, requires_grad=True)
        (slope,) = torch.autograd.grad(p.to_physical(raw).sum(), raw)
        assert slope.isfinite().all()


def test_bounds_per_entry_and_values_kept_in_float64():
    p = Parameter("position", [0.1, 0.2, 0.3], [0, -1, 0], [1, 1, 2])
    assert p.initial.tolist() == [0.1, 0.2, 0.3]
    assert p.map == "interval" and p.size == 3 and p.shape == (3,)
    assert p.to_physical(torch.full((3,), 99.0, dtype=torch.float64)).tolist() == [1, 1, 2]
    assert Parameter("p", 0.1).initial.shape == () and Parameter("p", 0.1).initial.item() == 0.1


def test_scale_defaults_to_the_distance_from_the_bound():
    assert Parameter("i", [3.0, 5.0], 1.0).scale == 3.0
    assert Parameter("i", [3.0, 5.0], upper=10.0).scale == 6.0
    assert Parameter("i", [3.0, 5.0]).scale == 1.0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (dict(initial=1.0, lower=0, upper=1), "parameter 'x': initial must be finite and strictly inside .* got 1$"),
        (dict(initial=[0.5, 1.5], lower=0, upper=1), r"strictly inside its bounds \(0, 1\), got 1.5 at index \[1\]"),
        (dict(initial=0.0, lower=0), "got 0"),
        (dict(initial=math.nan), "got nan"),
        (dict(initial=math.inf), "got inf"),
        (dict(initial=0.5, lower=1, upper=0), "lower must be below upper, got 1.0 and 0.0"),
        (dict(initial=0.5, lower=math.nan), "lower must not be NaN"),
        (dict(initial=[0.5, 0.5], lower=[0, -math.inf]), "finite for every entry or for none"),
        (dict(initial=[0.5, 0.5], lower=[0, 0, 0]), r"lower must broadcast to .*\[2\], got \[3\]"),
        (dict(initial=[]), "at least one entry"),
        (dict(initial=0.5, scale=0.0), "scale must be positive"),
    ],
)
def test_bad_descriptions(arguments, message):
    with pytest.raises(ValueError, match=message):
        Parameter("x", **arguments)


def test_bad_name_and_bad_values():
    with pytest.raises(ValueError, match="parameter name"):
        Parameter("", 1.0)
    p = Parameter("x", [0.5], 0, 1)
    with pytest.raises(ValueError, match="strictly inside"):
        p.to_raw(torch.ones(1, dtype=torch.float64))
    with pytest.raises(ValueError, match=re.escape("raw: expected shape [1], got [2]")):
        p.to_physical(torch.zeros(2, dtype=torch.float64))
    with pytest.raises(TypeError, match="raw must be a float64 tensor, got torch.float32"):
        p.to_physical(torch.zeros(1))


def test_a_value_on_its_bound_can_be_nudged_inside():
    parameter = Parameter("p", [0.5, 0.5, 0.5], lower=0.0, upper=2.0)
    nudged = parameter.nudge_inside(torch.tensor([0.0, 2.0, 1.25], dtype=torch.float64))
    assert nudged.tolist() == pytest.approx([2e-6, 2 - 2e-6, 1.25], rel=1e-12)
    torch.testing.assert_close(parameter.to_physical(parameter.to_raw(nudged)), nudged)
    free = Parameter("q", 0.0)
    assert free.nudge_inside(torch.tensor(3.0, dtype=torch.float64)).item() == 3.0
