import numpy as np
import pytest
import torch
from placement_tasks import HIGH, LOW, analytic_task

from difflpv.placement.reconstruction import fitted_content, reconstruction_error, relative_error
from difflpv.probes.tetrahedra import TetrahedralInterpolation


def some_probes(count: int, seed: int = 0) -> torch.Tensor:
    return torch.as_tensor(np.random.default_rng(seed).uniform(LOW + 0.1, HIGH - 0.1, (count, 3)))


def test_fitted_content_never_reconstructs_worse_and_a_strong_ridge_keeps_the_field() -> None:
    task, probes = analytic_task(points=200), some_probes(12)
    rows = TetrahedralInterpolation(probes).rows(probes, task.points)
    kept = fitted_content(task, probes, rows, ridge=1e9)
    torch.testing.assert_close(kept, task.field(probes), atol=1e-5, rtol=1e-5)
    free = fitted_content(task, probes, rows, ridge=1e-9)

    def residual(content: torch.Tensor) -> float:
        return float((rows.apply(content) - task.radiance).norm())

    assert residual(free) < residual(fitted_content(task, probes, rows)) < residual(kept)


@pytest.mark.parametrize("content", ["field", "fitted"])
def test_error_has_the_gradient_of_its_differences(content) -> None:
    task, probes = analytic_task(points=60), some_probes(8).requires_grad_(True)
    connectivity = TetrahedralInterpolation(probes.detach(), connectivity="held")
    assert torch.autograd.gradcheck(
        lambda p: reconstruction_error(task, p, content=content, interpolation=connectivity), (probes,), atol=1e-6
    )


def test_where_all_is_met_exactly_the_slope_is_none_and_not_nan() -> None:
    """Points at the only probe, in light that is the same everywhere."""
    even = analytic_task(points=3, radiance=lambda x: np.ones((*x.shape[:-1], 9, 3)))
    probe = torch.tensor(even.field.grid.cell_centers()[8, 8, 8][None]).requires_grad_(True)
    error = reconstruction_error(even, probe)
    error.backward()
    assert error.item() < 1e-100 and probe.grad is not None and not probe.grad.any()


def test_points_without_light_are_named() -> None:
    dark = analytic_task(points=20, radiance=lambda x: np.zeros((*x.shape[:-1], 9, 3)))
    with pytest.raises(ValueError, match="placement radiance: expected light at a point of some weight, got none"):
        reconstruction_error(dark, some_probes(4))
    with pytest.raises(ValueError, match="placement radiance: expected light at a point of some weight, got none"):
        relative_error(dark, dark.radiance)


def test_an_unknown_content_is_named() -> None:
    with pytest.raises(ValueError, match="content: expected field or fitted, got 'best'"):
        reconstruction_error(analytic_task(points=20), some_probes(4), content="best")  # type: ignore[arg-type]
