"""After how many solves a fit pays off: the arithmetic, a measured row, and how it is written."""

import csv
import io
import math

import pytest

from difflpv.bench.configuration import chosen
from difflpv.bench.measure import measure
from difflpv.bench.payoff import PAY_OFF_COUNTS, measure_pay_off, solves_to_pay_off
from difflpv.bench.scenes import bench_scenes
from difflpv.bench.sections import pay_off_section
from difflpv.bench.settings import BenchSettings
from difflpv.bench.store import pay_off_csv

SIZES = BenchSettings(repeats=2, patience=0.01, costly_receivers=1000)


@pytest.fixture(scope="module")
def rows(tmp_path_factory):
    folder = tmp_path_factory.mktemp("truth")
    scene, tuning = (
        bench_scenes("cornell", folder / str(seed), components=("bounce1",), receivers=60, spp=128, seed=seed)[0]
        for seed in (0, 1)
    )
    names = ["learned_9x26, 16 cells, 16 steps, fitted", "path tracer, 4", "path tracer, 16"]
    points = measure(chosen(names), scene, repeats=1, gradients=False, memory=False, tuning=tuning)
    return measure_pay_off(points, scene, tuning, SIZES), tuning, points


def test_solves_that_pay_a_cost_off():
    assert solves_to_pay_off(6.0, 0.5, 2.0) == pytest.approx(4)
    assert solves_to_pay_off(6.0, 2.0, 2.0) is None and solves_to_pay_off(6.0, 3.0, 2.0) is None


def test_a_row_adds_up(rows):
    (row,), tuning, points = rows
    fitted = points[0]
    assert row["configuration"] == fitted.name and row["fit_seconds"] == fitted.setup_seconds["fit"]
    assert row["targets_seconds"] == tuning.target_seconds > 0
    assert row["error"] < row["error_before"]  # docs/benchmarks.md: 0.15 after 0.20
    for k, count in enumerate(row["counts"]):
        gain = row["traced_seconds"][k] - row["solve_seconds"][k]
        found, more = row["solves"][k], row["solves_with_setup"][k]
        if gain <= 0:
            assert found is None and more is None
            continue
        assert found * gain == pytest.approx(row["targets_seconds"] + row["fit_seconds"])
        assert (more - found) * gain == pytest.approx(row["setup_seconds"][k]) and count == PAY_OFF_COUNTS[k]
    assert row["traced_seconds"][-1] == pytest.approx(10 * row["traced_seconds"][-2])  # beyond what was traced
    assert row["solves"][-1] is not None  # a million receivers at 30 paths each take seconds, a solve does not


def test_rows_as_table_and_as_text(rows):
    found, _, _ = rows
    table = list(csv.DictReader(io.StringIO(pay_off_csv(found))))
    assert [int(line["receivers"]) for line in table] == list(PAY_OFF_COUNTS)
    assert float(table[-1]["solves"]) == found[0]["solves"][-1]
    never = {**found[0], "solves": [None] * 4, "solves_with_setup": [None] * 4}
    text = pay_off_section([found[0], never])
    assert text.count("never |") == 4 + sum(n is None for n in found[0]["solves"])
    assert f"{math.floor(found[0]['solves'][-1] + 0.5):,} (" in text or "1 (" in text
    assert list(csv.DictReader(io.StringIO(pay_off_csv([never]))))[0]["solves"] == ""
    assert pay_off_section([]).startswith("No fitted")
