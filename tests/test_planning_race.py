"""What the race may skip: laws on ladders of known errors, and how often chance gets a bad rung chosen."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from planning_judges import KnownJudge, rungs_of, sizes_of

from difflpv.bench.configuration import Configuration
from difflpv.config import LpvConfig
from difflpv.error_bounds import ErrorSamples
from difflpv.planning.explain import explain
from difflpv.planning.ladder import PLAN_LADDER, family_of
from difflpv.planning.plan import plan_with

CELLS = (8, 16, 24, 32, 64)
METHODS = ("learned_4x6", "learned_9x6", "learned_9x26")


def test_two_cell_sizes_are_a_family_of_their_own():
    """One size stops falling at 0.9, two sizes meet the tolerance: what the one says is no word on the other."""
    two = Configuration("two sizes", "volume", "learned", LpvConfig(method="learned_9x26", coarsen_after=10), cells=32)
    rungs = [*sizes_of((8, 16, 32)), two]
    judge = KnownJudge({"8": 0.9, "16": 0.9, "32": 0.9, "two sizes": 0.05}, {"8": 1, "16": 8, "32": 64, "two sizes": 60})
    plan = plan_with(judge, rungs, tolerance=0.1)
    assert plan.chosen.rung.name == "two sizes"
    assert ("16", 0) not in judge.judged  # 0.9 / 4 says no
    by_name = {rung.name: rung for rung in PLAN_LADDER}
    one, other = (by_name[f"learned_9x6, 32 cells, 32 steps{kind}"] for kind in ("", ", two sizes after 10"))
    assert family_of(one) != family_of(other)
    assert family_of(other) == family_of(by_name["learned_9x6, 64 cells, 32 steps, two sizes after 10"])


def test_finer_cells_are_not_tried_where_even_the_square_of_their_edge_would_not_do():
    rungs = sizes_of((8, 16, 32, 64))
    judge = KnownJudge({"8": 0.9, "16": 0.7, "32": 0.4, "64": 0.01}, {"8": 1, "16": 8, "32": 64, "64": 512})
    plan = plan_with(judge, rungs, tolerance=0.05)
    assert plan.chosen is None
    # 0.9 / 4 says no; 0.9 / 16 does not: 32 is judged; 0.4 / 4 says no
    assert [r.state for r in plan.runners] == ["out", "hopeless", "out", "hopeless"]
    assert plan_with(judge, rungs, tolerance=0.2).chosen.rung.name == "64"
    assert "is not met by anything on the ladder; best found 32: error 0.400" in explain(plan)


def families_of(known):
    """Rungs, errors and seconds of families: the error in 8 cells, and the powers by which it falls from size to size."""
    rungs, errors, seconds = [], {}, {}
    for number, (error, powers) in enumerate(known):
        for k, n in enumerate(CELLS):
            rung = Configuration(f"{number}: {n}", "volume", "learned", LpvConfig(method=METHODS[number]), cells=n)
            if k:
                error *= (CELLS[k - 1] / n) ** powers[k - 1]
            rungs.append(rung)
            errors[rung.name], seconds[rung.name] = error, n**3 * 1.37**number
    return rungs, errors, seconds


powers = st.lists(st.floats(-1, 2), min_size=4, max_size=4)


@settings(max_examples=150, deadline=None)
@given(st.floats(0.05, 2.0), powers, st.floats(0.01, 1.0))
def test_no_answer_is_skipped_while_errors_fall_no_faster_than_the_square(first, powers, tolerance):
    """One family falls by any power up to 2 from size to size, or rises."""
    answer_is_found(*families_of([(first, powers)]), tolerance)


@settings(max_examples=150, deadline=None)
@given(st.lists(st.tuples(st.floats(0.05, 2.0), st.lists(st.floats(0.94, 1.06), min_size=5, max_size=5)), min_size=1,
       max_size=3), st.lists(st.floats(-1, 1.4), min_size=4, max_size=4), st.floats(0.01, 1.0))  # fmt: skip
def test_no_answer_is_skipped_while_families_fall_alike(known, powers, tolerance):
    """The same powers for all, but for scatter within the margin of 1.15 between two sizes of two families."""
    rungs, errors, seconds = families_of([(first, powers) for first, _ in known])
    for number, (_, scatter) in enumerate(known):
        for n, factor in zip(CELLS, scatter, strict=True):
            errors[f"{number}: {n}"] *= factor**0.5
    answer_is_found(rungs, errors, seconds, tolerance)


def answer_is_found(rungs, errors, seconds, tolerance):
    plan = plan_with(KnownJudge(errors, seconds), rungs, tolerance=tolerance)
    meeting = [seconds[name] for name in errors if errors[name] <= tolerance]
    assert (plan.chosen is None) == (not meeting)
    if meeting:
        assert errors[plan.chosen.rung.name] <= tolerance
        assert seconds[plan.chosen.rung.name] <= 1.05 * min(meeting) * (1 + 1e-9)


def test_what_finer_cells_did_to_one_stencil_foretells_the_next():
    """32 cells bought the first a tenth of its error: not a half of the second's, whatever the square of the edge says."""
    methods = {"one": "learned_9x6", "other": "learned_9x26"}
    rungs = [Configuration(f"{name} {n}", "volume", "learned", LpvConfig(method=method), cells=n)
             for name, method in methods.items() for n in (16, 32)]  # fmt: skip
    errors = {"one 16": 0.6, "one 32": 0.54, "other 16": 0.5, "other 32": 0.15}
    judge = KnownJudge(errors, {"one 16": 1, "one 32": 8, "other 16": 2, "other 32": 16})
    plan = plan_with(judge, rungs, tolerance=0.2)
    assert plan.chosen is None
    assert {r.rung.name for r in plan.runners if r.state == "hopeless"} == {"other 32"}  # 0.5 x 0.9 / 1.15 = 0.39
    assert plan_with(judge, rungs, tolerance=0.3).chosen.rung.name == "other 32"
    eight = {"one 8": 0.5, "one 32": 0.45, "other 8": 0.4, "other 32": 0.1}  # 8 cells say too little
    rungs = [replace(r, name=r.name.replace("16", "8"), cells=8 if r.cells == 16 else 32) for r in rungs]
    judge = KnownJudge(eight, {"one 8": 1, "one 32": 8, "other 8": 2, "other 32": 16})
    assert plan_with(judge, rungs, tolerance=0.2).chosen.rung.name == "other 32"


def probes_in(volume, count, name):
    return replace(volume, name=name, kind="lit probes", family="LPV-lit probes", probes=count)


def test_probes_are_not_tried_where_their_volume_says_no_and_chosen_where_lookups_count():
    (volume,) = sizes_of((16,))
    rungs, errors = [volume, probes_in(volume, 64, "probes")], {"16": 0.3, "probes": 0.25}
    judge = KnownJudge(errors, {"16": 1.0, "probes": 1.1})
    plan = plan_with(judge, rungs, tolerance=0.2)  # 0.3 / 1.15
    assert [r.state for r in plan.runners] == ["out", "hopeless"]
    assert plan_with(judge, rungs, tolerance=0.27).chosen.rung.name == "probes"
    assert plan_with(judge, rungs, tolerance=0.4).chosen.rung.name == "16"
    judge = KnownJudge(errors, {"16": 9.0, "probes": 1.1})
    judge.moving, judge.work = 1000, lambda rung: 1e9  # the same solve; their lookups are cheaper
    assert plan_with(judge, rungs, tolerance=0.4).chosen.rung.name == "probes"


class EasierFirst(KnownJudge):
    """The first level's light is easier or harder for all rungs alike, but for some scatter."""

    slack = (1.4, 1.0, 1.0)

    def __init__(self, errors, seconds, factor, scatter):
        super().__init__(errors, seconds)
        self.factor, self.scatter = factor, scatter

    def seen(self, rung, level):
        return self.errors[rung.name] * (self.factor * self.scatter[rung.name] if level == 0 else 1)


rows = st.lists(st.tuples(st.floats(0.05, 1.0), st.floats(0.96, 1.04), st.floats(1e-3, 10.0)), min_size=1, max_size=12)


@settings(max_examples=150, deadline=None)
@given(rows, st.floats(0.5, 1.3), st.floats(0.05, 1.0))
def test_what_others_foretell_costs_no_answer_while_levels_differ_alike(known, factor, tolerance):
    rungs = rungs_of(len(known))
    errors, scatter, seconds = ({r.name: row[k] for r, row in zip(rungs, known, strict=True)} for k in range(3))
    plan = plan_with(EasierFirst(errors, seconds, factor, scatter), rungs, tolerance=tolerance)
    meeting = [name for name in errors if errors[name] <= tolerance]
    assert (plan.chosen is None) == (not meeting)
    if meeting:
        assert errors[plan.chosen.rung.name] <= tolerance
        assert seconds[plan.chosen.rung.name] <= 1.05 * min(seconds[name] for name in meeting) * (1 + 1e-9)


def test_one_that_was_judged_closely_saves_the_others_it():
    """An easy first light lets all through until one has shown what the others' light does to the error."""
    rungs = rungs_of(10)
    errors = {r.name: 0.3 - 0.001 * i for i, r in enumerate(rungs)}
    judge = EasierFirst(errors, {r.name: 1.5**i for i, r in enumerate(rungs)}, 0.6, {r.name: 1.0 for r in rungs})
    plan = plan_with(judge, rungs, tolerance=0.2)
    assert plan.chosen is None
    assert [name for name, level in judge.judged if level > 0] == ["rung 0"]
    assert [r.state for r in plan.runners] == ["out"] + 9 * ["unsure"]
    # the best is the most accurate on the level that all were judged on, not the one that was judged most closely
    assert plan.best.rung.name == "rung 9"
    assert "best found rung 9: error 0.175" in explain(plan) and "judged roughly, on level 1 of 3" in explain(plan)


def test_a_foretelling_leaves_a_margin():
    """One read 4 % too low on the first level, the other 4 % too high: the second still gets its chance, and meets."""
    errors, seconds = {"rung 0": 0.25, "rung 1": 0.2}, {"rung 0": 1.0, "rung 1": 2.0}
    judge = EasierFirst(errors, seconds, 1.0, {"rung 0": 0.96, "rung 1": 1.04})
    assert plan_with(judge, rungs_of(2), tolerance=0.2).chosen.rung.name == "rung 1"
    judge = EasierFirst(errors, seconds, 1.0, {"rung 0": 0.96, "rung 1": 1.2})
    assert plan_with(judge, rungs_of(2), tolerance=0.2).runners[1].state == "unsure"


def test_half_the_tolerance_is_foretold_by_what_a_closer_look_did_to_the_best():
    """Read 0.12 under an easy light, 0.2 all told: not half of 0.3. What the tolerance has rejected meets no half of it."""
    rungs = rungs_of(3)
    errors = {"rung 0": 0.25, "rung 1": 0.2, "rung 2": 0.1}
    judge = EasierFirst(errors, {"rung 0": 1.0, "rung 1": 1.05, "rung 2": 1.5}, 0.6, {r.name: 1.0 for r in rungs})
    plan = plan_with(judge, rungs, tolerance=0.3)
    assert plan.chosen.rung.name == "rung 0"
    plan.runners[1].estimates[:] = [judge.judge(rungs[1], 0)[0]]
    plan.runners[1].seconds = 1.05
    assert plan.foreseen(plan.runners[1]) == pytest.approx(0.2)
    assert "Half the tolerance, 0.15: dearer rungs were not judged" in explain(plan)
    plan.runners[2].estimates[:] = [judge.judge(rungs[2], 0)[0]]
    plan.runners[2].seconds = 1.5
    assert "Half the tolerance, 0.15: likely rung 2 (0.100), 1500.00 ms" in explain(plan)
    plan.runners[2].state = "unsure"
    assert "Half the tolerance, 0.15: dearer rungs were not judged" in explain(plan)


def test_times_are_repeated_for_what_meets_the_tolerance_and_its_rivals_only():
    """A rough time of the cheapest, 1.2 times too long, does not cost it the choice."""

    class Disturbed(KnownJudge):
        def rough(self, rung):
            return self.times[rung.name] * (1.2 if rung.name == "rung 1" else 1)

    rungs = rungs_of(4)
    errors = {"rung 0": 0.5, "rung 1": 0.1, "rung 2": 0.1, "rung 3": 0.1}
    judge = Disturbed(errors, {"rung 0": 0.5, "rung 1": 1.0, "rung 2": 1.15, "rung 3": 9.0})
    plan = plan_with(judge, rungs, tolerance=0.2)
    assert plan.chosen.rung.name == "rung 1"
    assert plan.chosen.seconds == 1.0
    assert set(judge.timed) <= {"rung 1", "rung 2"}


def test_a_slow_first_run_does_not_put_a_rung_over_the_budget():
    class Cold(KnownJudge):
        def rough(self, rung):
            return 3 * self.times[rung.name]

    rungs = rungs_of(3)
    judge = Cold({"rung 0": 0.5, "rung 1": 0.2, "rung 2": 0.1}, {"rung 0": 1.0, "rung 1": 4.0, "rung 2": 30.0})
    plan = plan_with(judge, rungs, budget=5.0)
    assert plan.chosen.rung.name == "rung 1" and plan.chosen.seconds == 4.0
    assert plan.runners[2].state == "dear" and "rung 2" not in judge.timed


@pytest.mark.parametrize("scale, most", [(1.005, 0.05), (1.3, 0.0)])
def test_chance_gets_a_bad_rung_chosen_no_oftener_than_the_confidence_says(scale, most):
    """Real bootstrap bounds, and levels that share receivers: an error of 1.005 or 1.3 tolerances may pass by chance."""
    tolerance, trials, chosen = 0.2, 250, 0
    rung = rungs_of(1)
    for trial in range(trials):
        squared = (scale * tolerance) ** 2 * np.random.default_rng([5, trial]).chisquare(3, (2, 400)) / 3

        class Sampled(KnownJudge):
            def judge(self, rung, level, squared=squared, trial=trial):
                cut = squared[:1, :120] if level == 0 else squared[:, :120] if level == 1 else squared
                return ErrorSamples(cut, np.ones_like(cut)).estimate(seed=trial), 1.0

        chosen += plan_with(Sampled({}, {"rung 0": 1.0}), rung, tolerance=tolerance).chosen is not None
    assert chosen <= most * trials + 3.5 * math.sqrt(trials * most * (1 - most))
