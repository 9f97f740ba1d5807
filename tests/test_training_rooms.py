import numpy as np
import pytest
import torch

from difflpv.raycast import Raycaster
from difflpv.training.room_loss import RoomResponse, fit_gains, mean_room_error
from difflpv.training.rooms import draw_room, traced_room


@pytest.mark.parametrize("index", range(12))
def test_rooms_are_closed_lie_in_their_grid_and_their_light_faces_inwards(index):
    scene, grid = draw_room(0, index)
    low, high = scene.bounds
    assert (low > grid.minimum).all() and (high < grid.maximum).all()
    panel = scene.meshes[-1]
    assert panel.name == "light" == scene.lights[0].mesh
    corners = panel.vertices
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    normal /= np.linalg.norm(normal)
    caster, center = Raycaster(scene), corners.mean(0)
    ahead = caster.closest(center[None] + 1e-3 * normal, normal[None]).distance[0]
    behind = caster.closest(center[None] - 1e-3 * normal, -normal[None]).distance[0]
    assert behind < 0.5 * grid.cell_size < ahead and np.isfinite(ahead)
    rng = np.random.default_rng(index)
    rays = rng.normal(size=(200, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    assert caster.closest(np.tile(center + 0.2 * grid.cell_size * normal, (200, 1)), rays).valid.all()


def test_rooms_repeat_by_seed_and_differ_by_number():
    assert draw_room(3, 4)[0].hash == draw_room(3, 4)[0].hash
    assert len({draw_room(seed, index)[0].hash for seed in (0, 1) for index in range(3)}) == 6


def response(gains, seed=0, noise=0.0):
    """Receivers whose truth is a sum of degrees with known gains."""
    g = torch.Generator().manual_seed(seed)
    by_degree = torch.randn(3, 40, 6, generator=g)
    truth = torch.tensordot(torch.tensor(gains), by_degree, 1) + noise * torch.randn(40, 6, generator=g)
    norm = torch.cat([part.norm().expand(3) for part in truth.split(3, dim=1)])
    return RoomResponse(by_degree / norm, -truth / norm)


def test_gains_are_found():
    rooms = [response([0.8, 0.7, 0.9], seed, noise=0.1) for seed in range(4)]
    np.testing.assert_allclose(fit_gains(rooms, 2), [0.8, 0.7, 0.9], atol=0.03)
    higher = [RoomResponse(torch.cat([room.by_degree, torch.zeros(1, 40, 6)]), room.rest) for room in rooms]
    assert fit_gains(higher, 3)[3] == 1
    best = mean_room_error(rooms, torch.tensor(fit_gains(rooms, 2)))
    assert best < mean_room_error(rooms, torch.tensor([0.8, 0.7, 0.8]))


@pytest.mark.slow
def test_targets_of_a_room_weigh_nothing_next_to_its_light(tmp_path):
    room = traced_room(0, 1, tmp_path, receivers=200, spp=64)
    panel = room.scene.meshes[-1].vertices.mean(0)
    distance = np.linalg.norm(room.receivers.position - panel, axis=1)
    weight = room.receivers.area_weight
    assert (weight[distance < room.grid.cell_size] == 0).all() and weight.sum() > 0
    assert set(room.irradiance) == {"direct", "bounce1"}
