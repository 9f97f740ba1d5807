"""The fewest probes that meet a tolerance: what is held out, what the bound holds for, and where the search ends."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from placement_tasks import analytic_task, point_light

from difflpv.placement.descent import Descent, Probes
from difflpv.placement.free_moves import FreeMoves
from difflpv.placement.penalties import Penalties
from difflpv.placement.place import place
from difflpv.placement.reconstruction import Reconstruction
from difflpv.placement.task import PlacementTask
from difflpv.placement.unseen import Unseen
from difflpv.probes.probe_set import DIRECTIONS_26, irradiance_of


def lamp(x: np.ndarray, where: tuple[float, float, float], size: float) -> np.ndarray:
    """The point light of the tests somewhere else, in an empty box."""
    return point_light(x + (np.array([-1.0, 0.3, 0.2]) - np.array(where)), wall=False, size=size)


def lamps_task(*where: tuple[float, float, float], size: float = 0.5, points: int = 400) -> PlacementTask:
    """One light set for each place."""
    return analytic_task(
        wall=False, points=points, radiance=lambda x: np.concatenate([lamp(x, place, size) for place in where], -1)
    )


def descent(task: PlacementTask, content="fitted") -> Descent:
    return Descent(Reconstruction(task, content), Penalties(), FreeMoves(task))


def test_points_and_lights_are_held_out_and_their_content_is_fitted_to_points_that_placed():
    task = lamps_task(*[(x, 0.0, 0.0) for x in (-1.5, -1.0, -0.5, 0.0, 0.5, 1.0, 1.5)], points=200)
    task = replace(task, weight=torch.rand(200, generator=torch.Generator().manual_seed(2)).double())
    unseen = Unseen.of(task)
    assert unseen.lights == (2, 5)
    assert [len(part.points) for part in (unseen.train, unseen.fit, unseen.judge)] == [160, 160, 40]
    assert torch.equal(unseen.train.points, unseen.fit.points)
    everything = torch.cat([unseen.train.points, unseen.judge.points])
    assert len(everything.unique(dim=0)) == 200
    torch.testing.assert_close(
        torch.cat([unseen.train.weights, unseen.judge.weights]).sort().values, task.weights.sort().values
    )
    placing, judging = [0, 1, 3, 4, 6], [2, 5]
    for part, lights in ((unseen.train, placing), (unseen.fit, judging), (unseen.judge, judging)):
        channels = [3 * light + rgb for light in lights for rgb in range(3)]
        rows = [task.points.tolist().index(point) for point in part.points.tolist()]
        assert torch.equal(part.radiance, task.radiance[rows][..., channels])
        assert torch.equal(part.field.values, task.field.values[..., channels])
    few = Unseen.of(lamps_task((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), points=20))
    assert few.lights == () and few.train.light_count == few.judge.light_count == 2
    with pytest.raises(ValueError, match="at least 5 points"):
        Unseen.of(task.part(points=torch.arange(4)))


@pytest.mark.parametrize("content", ["fitted", "field"])
def test_the_error_is_that_under_lights_held_out(content):
    lights = [(-1.5, 0.0, 0.0), (0.0, 0.0, 0.0), (-1.0, 0.0, 0.0), (1.0, 0.5, 0.0), (1.0, 0.0, 0.0), (1.7, 0.5, 0.5)]
    task = lamps_task(*lights, points=300)
    unseen = Unseen.of(task)
    probes = Probes(task.points.numpy()[7:60:4])
    down = descent(unseen.train, content)
    found = unseen.error(down, probes, confidence=0.95)
    position = torch.tensor(probes.position)
    rows = down.settled(probes).over(probes.position, task.scene).rows(position, unseen.judge.points)
    if content == "fitted":
        held = torch.as_tensor(descent(unseen.fit).content(probes))
    else:
        held = task.field(position)[..., [6, 7, 8, 15, 16, 17]]
    E, T = (irradiance_of(radiance, DIRECTIONS_26) for radiance in (rows.apply(held), unseen.judge.radiance))
    errors = [float((E - T)[..., k : k + 3].norm() / T[..., k : k + 3].norm()) for k in (0, 3)]
    assert found.error == pytest.approx(np.sqrt(np.mean(np.square(errors))), rel=1e-9)
    assert errors[0] != pytest.approx(errors[1], rel=0.05) and found.high > 0.95 * max(errors)  # it may be all of one kind
    assert found.low < found.error < found.high < unseen.error(down, probes, confidence=0.999).high


def test_lights_that_did_not_place_are_what_counts():
    near, far = (-1.5, 0.0, 0.0), (1.6, 0.3, 0.3)
    same, other = (lamps_task(near, near, last, size=0.6) for last in (near, far))
    options = {"steps": 12, "relocations": 0, "tolerance": 0.5}
    # probes gather where the light is that placed them: under one on the other side as many are not enough
    easy, honest = (place(task, 24, "gradient", **options) for task in (same, other))
    assert easy.details["lights_held_out"] == honest.details["lights_held_out"] == (2,)
    assert easy.details["met"] and easy.details["held_out_error"] < easy.details["held_out_bound"] <= 0.5
    assert not honest.details["met"] and len(honest) == 24


def test_lights_held_out_that_are_dark_meet_nothing():
    """No error can be seen there: it was 0, and the first eight probes met every tolerance."""
    task = lamps_task((-1.5, 0.0, 0.0), (1.0, 0.0, 0.0), (1.6, 0.3, 0.3), points=100)
    radiance = task.radiance.clone()
    radiance[..., 6:] = 0
    with pytest.raises(ValueError, match="tolerance: expected light at the points held out under light sets 2, got none"):
        place(replace(task, radiance=radiance), 10, "gradient", steps=4, tolerance=0.1)


def test_ends_with_few_probes_that_meet_it():
    task = lamps_task((-1.0, 0.3, 0.2), size=1.5)
    options = {"steps": 12, "relocations": 0}
    loose = place(task, 40, "gradient", tolerance=0.5, **options)
    tight = place(task, 40, "gradient", tolerance=0.3, **options)
    assert loose.details["met"] and tight.details["met"], (loose.details, tight.details)
    assert loose.details["held_out_bound"] <= 0.5 and tight.details["held_out_bound"] <= 0.3
    assert len(loose) < len(tight) <= 40
    sure = place(task, 40, "gradient", tolerance=0.3, confidence=0.999, **options)
    assert len(sure) >= len(tight)
    never = place(task, 6, "gradient", tolerance=0.001, **options)
    assert not never.details["met"] and len(never) == 6
