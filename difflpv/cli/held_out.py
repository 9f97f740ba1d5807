"""How a fit does on what it learned from and on what it did not: peers, other lights, scenes never seen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from difflpv.cli.options import UsageError

if TYPE_CHECKING:
    import torch

    from data_gen.load import Targets
    from difflpv.evaluate import Score
    from difflpv.fit import FitOutcome, LightTarget
    from difflpv.pipeline import Lpv
    from difflpv.scene import Scene

__all__ = ["Unseen", "overfitting", "peer_scores", "unseen_scene", "unseen_scores"]


@dataclass(frozen=True, eq=False)
class Unseen:
    """Another scene with targets, to be judged on."""

    label: str
    scene: Scene
    targets: Targets


def unseen_scene(text: str, learn: Sequence[str], component: str) -> Unseen:
    """``SCENE=DIR`` of ``--unseen``, read and checked before a fit begins.

    Args:
        text: the option's value.
        learn: what the fit will learn.
        component: "direct" or "bounce1".

    Raises:
        UsageError: a learnable that can not be carried to another scene, or targets without the component.
    """
    from data_gen.load import load_targets
    from difflpv.io import load_scene
    from difflpv.learnables import GLOBAL_LEARNABLES

    name, equals, folder = text.partition("=")
    if not (name and equals and folder):
        raise UsageError(f"--unseen: expected SCENE=TARGETS, as two_rooms_90=out/targets, got '{text}'")
    bound = [learned for learned in learn if learned not in GLOBAL_LEARNABLES]
    if bound:
        raise UsageError(f"--unseen: {', '.join(bound)} can not be carried from the fitted scene or grid to another")
    scene, targets = load_scene(name), load_targets(folder)
    targets.check_scene(scene)
    if component not in targets.components:
        raise UsageError(f"--unseen: {folder} has {', '.join(targets.components)}, not {component}")
    return Unseen(text, scene, targets)


def peer_scores(outcome: FitOutcome, lights: Sequence[LightTarget], group: Sequence[int]) -> list[Score]:
    """Means over some lights: constant, as published, untuned at this configuration, fitted."""
    from difflpv.config import LpvConfig
    from difflpv.evaluate import mean_score
    from difflpv.fit import score_lights
    from difflpv.pipeline import Lpv

    if not group:
        return []
    lpv = outcome.lpv
    method = lpv.config.method
    constant, untuned, fitted = outcome.mean_scores(group)
    peers = [constant, replace(untuned, method=f"{method} untuned"), fitted]
    if method in ("lpv", "holpv"):
        published = Lpv(lpv.grid, LpvConfig(method=method))
        name = f"{method} as published"
        alone = [s for t in lights if t.index in group for s in score_lights(t, {name: published}) if s.method == name]
        peers.insert(1, mean_score(alone))
    return peers


def unseen_scores(unseen: Unseen, lpv: Lpv, component: str, *, seed: int, device: torch.device) -> list[Score]:
    """Means over the lights of another scene: constant, untuned, and with what ``lpv`` has learned.

    Args:
        unseen: the scene.
        lpv: the fitted model.
        component: "direct" or "bounce1".
        seed: of the light samples.
        device: where to solve.
    """
    from difflpv.config import grid_for
    from difflpv.evaluate import mean_score
    from difflpv.fit import light_target, score_lights
    from difflpv.pipeline import Lpv

    scene, targets = unseen.scene, unseen.targets
    grid = grid_for(scene, lpv.grid.resolution[0])
    carried = Lpv(grid, lpv.config, learn=lpv.learned)
    carried.set_values({key: value.detach() for key, value in lpv.values().items()})
    method = lpv.config.method
    models = {f"{method} untuned": Lpv(grid, lpv.config), f"{method} fitted": carried}
    scores: list[Score] = []
    for k, light in enumerate(targets.lights):
        target = light_target(
            scene, light.entries, grid, lpv.config, component, index=k, position=targets.receivers.position,  # type: ignore[arg-type]
            normal=targets.receivers.normal, irradiance=light.irradiance[component], weight=light.area_weight, seed=seed,
            device=device,
        )  # fmt: skip
        scores += score_lights(target, models)
    return [mean_score([s for s in scores if s.method == m]) for m in dict.fromkeys(s.method for s in scores)]


def overfitting(train: Sequence[Score], test: Sequence[Score]) -> list[str]:
    """A line where the fit helped the lights it saw at least twice as much as the others; nothing elsewhere."""
    before, after = (next(s for s in reversed(train) if s.method.endswith(end)) for end in ("untuned", "fitted"))
    unseen_before, unseen_after = (next(s for s in test if s.method.endswith(end)) for end in ("untuned", "fitted"))
    gained = 1 - after.relative_l2 / before.relative_l2
    carried = 1 - unseen_after.relative_l2 / unseen_before.relative_l2
    if gained <= 0.02 or carried > 0.5 * gained:
        return []
    return [
        f"overfitting: error fell by {100 * gained:.0f} % on train lights, by {100 * carried:.0f} % on test lights; "
        "learn fewer numbers, raise --sparsity or train on more lights"
    ]
