"""Irradiance along lines: points in the open, the truth against a quadrature, and the chart."""

import numpy as np
import pytest

from difflpv.bench.scanlines import SCANLINES, Scanline, line_points, measure_scanlines
from difflpv.bench.scenes import bench_scenes
from difflpv.io import load_scene
from difflpv.report.bench import draw_scanline, svg_text


@pytest.fixture(scope="module")
def rows(tmp_path_factory):
    folder = tmp_path_factory.mktemp("truth")
    scene = bench_scenes("diagonal", folder, components=("direct",), receivers=20, spp=32)[0]
    return scene, measure_scanlines(scene, spp=512, cell_spp=32)


def panel_irradiance(scene, position, count=200):
    """Irradiance [n] of a floor under a one-sided parallelogram, mean of the channels, by the midpoint rule."""
    (light,) = scene.lights
    mesh = next(m for m in scene.meshes if m.name == light.mesh)
    a, b, _, d = mesh.vertices
    u, v = np.meshgrid(*2 * [(np.arange(count) + 0.5) / count])
    points = a + u.reshape(-1, 1) * (b - a) + v.reshape(-1, 1) * (d - a)
    cross = np.cross(*(mesh.vertices[mesh.triangles[0]][k] - mesh.vertices[mesh.triangles[0]][0] for k in (1, 2)))
    normal, area = cross / np.linalg.norm(cross), np.linalg.norm(np.cross(b - a, d - a))
    found = []
    for x in position:
        way = points - x
        far = np.linalg.norm(way, axis=1)
        form = np.maximum(way[:, 1], 0) * np.maximum(-(way @ normal), 0) / far**4
        found.append(light.radiance.mean() * form.mean() * area)
    return np.array(found)


def test_truth_is_the_light_of_the_panel_within_its_noise(rows):
    scene, (floor, diagonal) = rows
    assert (floor["line"], diagonal["line"]) == ("floor", "diagonal")
    position = line_points(scene.scene, SCANLINES["diagonal/direct"][0])[1]
    exact, found, noise = panel_irradiance(scene.scene, position), np.array(floor["truth"]), np.array(floor["standard_error"])
    assert len(found) == len(floor["distance"]) == len(position)
    # eight replicates: their standard error is itself uncertain by a quarter
    assert (abs(found - exact) < 8 * noise + 1e-3 * exact).all() and np.median(abs(found - exact) / exact) < 0.02
    assert floor["errors"]["learned_9x26"] < 0.3 < floor["errors"]["LPV as published"]  # docs/benchmarks.md: 0.12, 1.33


def test_points_under_a_block_are_left_out():
    scene = load_scene("cornell")
    through = Scanline("through", (-2.7, 0.0, -2.7), (2.7, 0.0, 2.7))
    distance, position = line_points(scene, through, 201)
    assert 60 < len(distance) < 140  # both blocks stand on it
    np.testing.assert_allclose(np.linalg.norm(position - through.begin, axis=1), distance, atol=1e-12)
    gaps = np.diff(distance) > 2 * np.diff(distance).min()
    assert gaps.sum() == 2
    for line in SCANLINES["cornell/bounce1"]:
        assert len(line_points(scene, line, 50)[0]) == 50


def test_scenes_without_lines_have_no_rows(tmp_path):
    scene = bench_scenes("bunny", tmp_path, components=("bounce1",), receivers=20, spp=64)[0]
    assert measure_scanlines(scene, spp=8, cell_spp=8) == []


def test_the_chart_tells_errors_and_goes_logarithmic_past_a_near_light(rows):
    _, (floor, diagonal) = rows
    figures = [draw_scanline(row) for row in (floor, diagonal)]
    assert [figure.axes[0].get_yscale() for figure in figures] == ["linear", "log"]
    shown = {text.get_text() for text in figures[0].legends[0].get_texts()}
    assert f"learned_9x26: error {floor['errors']['learned_9x26']:.2f}" in shown and "path traced" in shown
    assert svg_text(figures[0]).lstrip().startswith("<?xml")
