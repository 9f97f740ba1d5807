import json
from pathlib import Path

import numpy as np
import pytest
import torch

from difflpv.propagation import propagate, propagate_moving
from difflpv.sh import cosine_lobe
from difflpv.stability import stability
from difflpv.stencil import LinearStencil, holpv_stencil
from difflpv.stencil_files import LEARNED_STENCILS, learned_stencil, load_stencil
from difflpv.symmetry import equivariant_basis, neighborhood_offsets, project_equivariant
from difflpv.training.objective import FreeSpaceLoss, PlaneLoss, Shell, growth_penalty, truncation_floor
from difflpv.training.octant import IMPULSES, octant_responses
from difflpv.training.stencils import RUNGS, TrainingError, train_stencil

SHEETS = Path(__file__).resolve().parents[1] / "difflpv" / "data" / "stencils"


def sampled_error(stencil, lo, hi, steps, emitters, seed):
    """The protocol of the published numbers: random emitters, receivers and normals on the whole grid."""
    rng, half = np.random.default_rng(seed), int(hi) + 2
    axis = np.arange(-half, half + 1)
    z, y, x = np.meshgrid(axis, axis, axis, indexing="ij")
    r = np.stack([x, y, z], -1)
    distance = np.linalg.norm(r, axis=-1)
    inside = (distance >= lo) & (distance <= hi)
    d = rng.normal(size=(emitters, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    n = rng.normal(size=(inside.sum(), 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    u = r[inside] / distance[inside][:, None]
    truth = np.maximum(d @ u.T, 0) * np.maximum(-(n * u).sum(1), 0) / np.pi
    volume = torch.zeros((emitters, stencil.matrices.shape[1], *distance.shape))
    volume[:, :, half, half, half] = torch.tensor(cosine_lobe(d, stencil.l_max) / np.pi)
    light = propagate(volume, stencil, steps=steps).numpy()[:, :, inside]
    found = np.einsum("bkm,mk->bm", light, cosine_lobe(-n, stencil.l_max)) * distance[inside] ** 2
    return np.linalg.norm(found - truth) / np.linalg.norm(truth)


def test_truncation_floor_against_quadrature():
    # Independent: project a clamped cosine onto degree l_max by sampling cos(theta) evenly.
    mu = (np.arange(200_000) + 0.5) / 100_000 - 1
    legendre = [np.ones_like(mu), mu, (3 * mu**2 - 1) / 2, (5 * mu**3 - 3 * mu) / 2]
    cosine = np.maximum(mu, 0)
    for l_max in (1, 2, 3):
        kept = sum((2 * k + 1) * (cosine * legendre[k]).mean() ** 2 for k in range(l_max + 1)) / (cosine**2).mean()
        assert truncation_floor(l_max) == pytest.approx(np.sqrt(1 - kept**2), abs=1e-6)
    assert truncation_floor(2) == pytest.approx(0.1247, abs=1e-4)


def test_octant_is_the_full_grid():
    basis = equivariant_basis(2, 26)
    matrices = torch.tensor(np.tensordot(np.random.default_rng(0).normal(size=len(basis)) / 20, basis, 1))
    volume = torch.zeros((4, 9, 9, 9, 9), dtype=torch.float64)
    for j, i in enumerate(IMPULSES[2].index):
        volume[j, i, 4, 4, 4] = 1
    full = propagate(volume, LinearStencil("any", np.array(neighborhood_offsets(26)), matrices.numpy()), steps=6)
    octant = octant_responses(matrices, neighbors=26, l_max=2, size=5, stops=(3, 6))
    torch.testing.assert_close(octant[-1], full[:, :, 4:, 4:, 4:].movedim(1, -1), rtol=1e-12, atol=1e-14)


def test_a_second_derivative_of_responses_is_refused():
    """It was wrong: the volumes between the steps are kept as numbers."""
    matrices = torch.tensor(np.array(equivariant_basis(1, 6)[3])).requires_grad_(True)
    squares = octant_responses(matrices, neighbors=6, l_max=1, size=3, stops=(2,)).square().sum()
    (gradient,) = torch.autograd.grad(squares, matrices, create_graph=True)
    with pytest.raises(RuntimeError, match="differentiate twice|not have been used"):
        torch.autograd.grad(gradient.sum(), matrices)


@pytest.mark.parametrize("rung", [(1, 6), (2, 26), (3, 26)])
def test_gradient_by_finite_differences(rung):
    l_max, neighbors = rung
    basis = torch.tensor(np.array(equivariant_basis(l_max, neighbors)))
    loss = FreeSpaceLoss(l_max, neighbors, (Shell(3, 1, 3), Shell(6, 2, 4, 0.5)), size=4, dtype=torch.float64)
    start = (holpv_stencil if neighbors == 26 else lpv)(l_max=l_max).linear_part
    theta = torch.tensor(project_equivariant(start, neighbors=neighbors), requires_grad=True)
    loss(torch.tensordot(theta, basis, 1)).backward()
    direction = torch.tensor(np.random.default_rng(1).normal(size=len(basis)))
    with torch.no_grad():
        up, down = (loss(torch.tensordot(theta + e * direction, basis, 1)) for e in (1e-5, -1e-5))
    assert abs(theta.grad @ direction) > 1e-3
    assert (theta.grad @ direction).item() == pytest.approx(((up - down) / 2e-5).item(), rel=1e-6)


def test_matrices_of_the_first_steps():
    basis = torch.tensor(np.array(equivariant_basis(2, 26)))
    theta = torch.tensor(np.random.default_rng(0).normal(size=(3, len(basis))) / 20, requires_grad=True)
    offsets = np.array(neighborhood_offsets(26))
    volume = torch.zeros((4, 9, 9, 9, 9), dtype=torch.float64)
    for j, i in enumerate(IMPULSES[2].index):
        volume[j, i, 4, 4, 4] = 1
    moving, total = volume, volume
    for step in range(4):
        own = torch.tensordot(theta[min(step, 2)].detach(), basis, 1).numpy()
        moving = propagate_moving(moving, LinearStencil("any", offsets, own), steps=1)[1]
        total = total + moving
    loss = FreeSpaceLoss(2, 26, (Shell(2, 1, 3), Shell(4, 2, 4, 0.5)), size=5, dtype=torch.float64)

    def matrices(numbers):
        return torch.tensordot(numbers, basis, 1)

    found = loss.responses(matrices(theta))
    torch.testing.assert_close(found[-1].detach(), total[:, :, 4:, 4:, 4:].movedim(1, -1), rtol=1e-12, atol=1e-14)
    loss(matrices(theta)).backward()
    direction = torch.tensor(np.random.default_rng(1).normal(size=theta.shape))
    with torch.no_grad():
        up, down = (loss(matrices(theta + e * direction)) for e in (1e-5, -1e-5))
    assert (theta.grad.abs().sum(1) > 1e-3).all()
    assert (theta.grad * direction).sum().item() == pytest.approx(((up - down) / 2e-5).item(), rel=1e-6)


def lpv(**kwargs):
    from difflpv.stencil import lpv_stencil

    return lpv_stencil(**kwargs)


def test_exact_error_is_the_mean_of_the_sampled_one():
    own = learned_stencil("learned_9x26")
    loss = FreeSpaceLoss(2, 26, (Shell(12, 2, 7),), size=10, dtype=torch.float64)
    exact = loss.errors(torch.tensor(own.matrices))[0]
    assert sampled_error(own, 2, 7, 12, emitters=96, seed=1) == pytest.approx(exact, rel=0.03)


def test_plane_predictions_are_those_of_a_lit_patch():
    # Independent: light every cell of a 7 x 7 patch on the whole grid and read the axis.
    own = learned_stencil("learned_9x26")
    loss = FreeSpaceLoss(2, 26, (Shell(8, 2, 7),), size=14, dtype=torch.float64)
    predicted, truth = PlaneLoss(2, size=14, dtype=torch.float64, weight=1.0).predictions(
        loss.responses(torch.tensor(own.matrices))[-1]
    )
    up = np.array([0.0, 0.0, 1.0])
    volume = torch.zeros((1, 9, 27, 27, 27), dtype=torch.float64)
    volume[0, :, 13, 10:17, 10:17] = torch.tensor(cosine_lobe(up, 2) / np.pi)[:, None, None]
    light = propagate(volume, own, steps=8)[0, :, :, 13, 13].numpy()
    predicted, truth = predicted.numpy().reshape(-1, 4)[:, 1], truth.numpy().reshape(-1, 4)[:, 1]
    assert predicted[0] == pytest.approx(light[:, 13] @ cosine_lobe(-up, 2), abs=1e-12)  # level with it, facing up
    assert predicted[1] == pytest.approx(light[:, 14] @ cosine_lobe(up, 2), abs=1e-12)  # one cell above, facing down
    assert predicted[3] == pytest.approx(light[:, 12] @ cosine_lobe(-up, 2), abs=1e-12)  # one cell below, facing up
    assert truth[0] == truth[3] == 0
    y, x = np.mgrid[-3:4, -3:4]
    assert truth[1] == pytest.approx((1 / (x * x + y * y + 1.0) ** 2 / np.pi).sum())


@pytest.mark.parametrize("name", LEARNED_STENCILS)
def test_shipped_errors_reproduce(name):
    sheet, stencil = json.loads((SHEETS / f"{name}.json").read_text()), learned_stencil(name)
    loss = FreeSpaceLoss(stencil.l_max, RUNGS[name].neighbors, (Shell(20, 2, 9.5),), size=18, dtype=torch.float32)
    found = loss.errors(torch.tensor(stencil.matrices, dtype=torch.float32))[0]
    assert found == pytest.approx(sheet["training"]["errors"]["2..9.5 cells, 20 steps"], rel=1e-3)
    published = (lpv() if RUNGS[name].neighbors == 6 else holpv_stencil()).linear_part
    worse = FreeSpaceLoss(published.l_max, RUNGS[name].neighbors, (Shell(20, 2, 9.5),), size=11, dtype=torch.float32)
    assert found < 0.8 * worse.errors(torch.tensor(published_aligned(published, RUNGS[name].neighbors)))[0]


def published_aligned(stencil, neighbors):
    basis = equivariant_basis(stencil.l_max, neighbors)
    return np.tensordot(project_equivariant(stencil, neighbors=neighbors), basis, 1).astype(np.float32)


def test_growth_penalty_is_zero_for_the_published_and_not_above():
    k = torch.tensor(np.random.default_rng(0).uniform(0, np.pi, (30, 3)))
    matrices = torch.tensor(published_aligned(holpv_stencil().linear_part, 26), dtype=torch.float64)
    assert growth_penalty(matrices, 26, k, margin=1e-3) == 0
    hot = (3 * matrices).requires_grad_(True)
    value = growth_penalty(hot, 26, k, margin=0.0)
    value.backward()
    assert value > 0 and hot.grad.abs().max() > 0


@pytest.mark.slow
def test_training_lowers_the_loss_and_resumes_bit_for_bit(tmp_path):
    settings = {"rounds": 4, "rooms": 0}
    whole = train_stencil("learned_4x6", **settings, out=tmp_path / "whole")
    assert whole.finished and whole.losses[1] > whole.losses[2] > whole.losses[3]  # the first stage reads other shells
    assert stability(whole.stencil).stable and whole.stencil.uniform_gain()[0, 0] == pytest.approx(1, abs=1e-15)
    part = train_stencil("learned_4x6", **settings, minutes=0, out=tmp_path / "part")
    assert part.rounds == 1 and not part.finished
    calls = 1
    while not part.finished:
        part = train_stencil("learned_4x6", **settings, minutes=0, out=tmp_path / "part")
        calls += 1
    assert calls == 4
    assert (part.stencil.matrices == whole.stencil.matrices).all() and part.losses == whole.losses
    assert (load_stencil(tmp_path / "part" / "learned_4x6.safetensors").matrices == whole.stencil.matrices).all()
    with pytest.raises(TrainingError, match=r"made with other settings \(seed\)"):
        train_stencil("learned_4x6", **settings, seed=1, out=tmp_path / "part")


@pytest.mark.slow
def test_rooms_fit_the_gains_alone_and_help_rooms_that_were_not_fitted(tmp_path):
    start = SHEETS / "learned_9x26.safetensors"
    result = train_stencil("learned_9x26", start=start, rounds=0, rooms=3, out=tmp_path)
    assert result.finished and stability(result.stencil).stable
    assert np.abs(result.stencil.matrices - load_stencil(start).matrices).max() < 1e-12
    assert all(0.5 < g < 1 for g in result.stencil.lookup_gains)
    report = json.loads((tmp_path / "learned_9x26.json").read_text())["training"]["rooms"]
    assert report["held_out_error"] < 0.9 * report["held_out_error_without"]
    assert load_stencil(tmp_path / "learned_9x26.safetensors").lookup_gains == result.stencil.lookup_gains
    again = train_stencil("learned_9x26", start=start, rounds=0, rooms=3, out=tmp_path)
    assert again.stencil.lookup_gains == tuple(report["gains"])


def test_training_errors_name_what_was_expected(tmp_path):
    with pytest.raises(TrainingError, match="rung: expected one of learned_4x6.*got 'learned_2x2'"):
        train_stencil("learned_2x2", out=tmp_path)
    with pytest.raises(TrainingError, match="rounds: expected at least 1, or 0 with a stencil to start from, got 0"):
        train_stencil("learned_4x6", rounds=0, out=tmp_path)
    (tmp_path / "learned_4x6.checkpoint").write_bytes(b"junk")
    with pytest.raises(TrainingError, match="checkpoint: damaged"):
        train_stencil("learned_4x6", out=tmp_path)
    with pytest.raises(ValueError, match="shells: expected 0 < near < far <= 4"):
        FreeSpaceLoss(1, 6, (Shell(3, 1, 5),), size=4, dtype=torch.float32)
