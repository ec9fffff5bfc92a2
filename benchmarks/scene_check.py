"""Count the warnings of the scene check on contradictory scenes and on correct scenes.

    python benchmarks/scene_check.py TOWN TOWN TOWN SCENE SCENE [--wrong 240] [--right 400]
        [--trained 60] [--out FILE]

The towns are made by benchmarks/towns.py, with 24 photos of each kind. Each wrong scene has a
random kind and strength of error, number of photos and points, crop, and ratio of fx to fy. Its
points may have no tracks. Some wrong scenes are trained for 150 steps on photos of 100 pixels. The
correct scene from which a wrong scene was made is trained in the same way. `fall` is the loss of
held-out PSNR by the error, as a mean by kind and strength. `found` counts the scenes for which the
correct cause or the correct photos were reported. Correct scenes have random photos and points,
gains, noise, JPEG quality and frames. No correct scene should get a warning.
"""

import argparse
import json
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from time import process_time

import numpy as np
from _contradictions import KINDS, Model, Wrong, harmless, varied
from _machine import code, facts

from crossgrad_core.commands import (
    assemble_new,
    begin,
    configured,
    take_steps,
)
from crossgrad_core.contract.scene import Scene
from crossgrad_core.errors import UserError
from crossgrad_core.evaluation.evaluation import evaluate
from crossgrad_core.run.assemble import read_scene
from crossgrad_core.run.export import renderer
from crossgrad_core.scene.self_check.evidence import pixels_of
from crossgrad_core.scene.self_check.verdict import Verdict, verdict_of

#: The check must report a scene if its error lowers the held-out PSNR by at least this value, in
#: dB.
FALL = 3.0


@dataclass(frozen=True)
class Outcome:
    """The result of a tested scene.

    Attributes:
        seed: Seed of the scene.
        base: The correct scene from which it was made.
        kind: Kind of error, or "right" for a correct scene.
        strength: Strength of the error.
        photos: Number of photos.
        tracks: True if its points have tracks.
        reported: The reported text.
        found: True if the check reported the correct cause or photos, or nothing for a correct
            scene.
        fall: Loss of held-out PSNR by the error, in dB; None if the scene was not trained.
        seconds: CPU seconds of the check.
    """

    seed: int
    base: str
    kind: str
    strength: str
    photos: int
    tracks: bool
    reported: str
    found: bool
    fall: float | None
    seconds: float


@cache
def base(path: Path, size: int) -> Model:
    """Return a correct scene with small photos."""
    config = configured({"scene": path, "threads": 1, "data": {"max_size": size}})
    return Model.of(read_scene(config, path)[0])


def trained_psnr(scene: Scene, path: Path, steps: int) -> float:
    """Return the held-out PSNR after a short training; 0 if training refuses the scene."""
    try:
        return _psnr(scene, path, steps)
    except UserError:
        return 0.0


def _psnr(scene: Scene, path: Path, steps: int) -> float:
    config = configured(
        {
            "scene": path,
            "threads": 1,
            "steps": steps,
            "seed": 0,
            "metrics": [{"name": "psnr"}],
            "plan": "off",
        }
    )
    setup = assemble_new(config, scene, "colmap")
    state = begin(setup)
    take_steps(setup, state)
    result = evaluate(scene.test_views, renderer(setup, state), setup.metrics)
    return float(result.overall.as_data()["psnr"] or 0.0)


def text_of(verdict: Verdict) -> str:
    """Return the reported causes in one line."""
    if verdict.all_wrong is not None:
        return verdict.all_wrong.what
    return "; ".join(f"{list(cause.views)}: {cause.what}" for cause in verdict.some_wrong)


def is_found(wrong: Wrong, verdict: Verdict) -> bool:
    """Return True if the correct cause or nearly the correct photos were reported."""
    causes = [each.what for each in (verdict.all_wrong, *verdict.some_wrong) if each is not None]
    named = {view for cause in verdict.some_wrong for view in cause.views}
    if not wrong.views:
        return any(word in cause for word in wrong.causes for cause in causes)
    if verdict.all_wrong is not None:
        return False
    return named <= wrong.views and 2 * len(named) >= len(wrong.views)


def wrong_scene(path: Path, seed: int, size: int, steps: int | None) -> Outcome:
    """Return the result for a scene that contradicts itself.

    The scene is trained only if a number of steps is given.
    """
    rng = np.random.default_rng(seed)
    right = varied(base(path, size), rng)
    kind = list(KINDS)[seed % len(KINDS)]
    wrong = KINDS[kind](right, rng)
    scene = wrong.model.scene()
    begun = process_time()
    verdict = verdict_of(scene, range(len(scene.views)), pixels_of(scene))
    seconds = process_time() - begun
    fall = None
    if steps is not None:
        fall = trained_psnr(right.scene(), path, steps) - trained_psnr(scene, path, steps)
    return Outcome(
        seed,
        path.name,
        kind,
        wrong.strength,
        len(scene.views),
        any(len(rows) for rows in right.seen),
        text_of(verdict),
        is_found(wrong, verdict),
        fall,
        seconds,
    )


def right_scene(path: Path, seed: int, size: int) -> Outcome:
    """Return the result for a correct scene."""
    rng = np.random.default_rng(seed)
    model = harmless(varied(base(path, size), rng), rng)
    scene = model.scene()
    begun = process_time()
    verdict = verdict_of(scene, range(len(scene.views)), pixels_of(scene))
    seconds, text = process_time() - begun, text_of(verdict)
    tracks = any(len(rows) for rows in model.seen)
    count = len(scene.views)
    return Outcome(seed, path.name, "right", "", count, tracks, text, not text, None, seconds)


def table(outcomes: list[Outcome]) -> Iterator[str]:
    """Yield the table of sensitivity by kind and strength, and a summary of all scenes."""
    cells: dict[tuple[str, str, bool], list[Outcome]] = defaultdict(list)
    for each in outcomes:
        if each.kind != "right":
            cells[each.kind, each.strength, each.tracks].append(each)
    yield "| kind | strength | tracks | scenes | found | fall, dB (trained) |"
    yield "|---|---|---|---|---|---|"
    hard: list[Outcome] = []
    for (kind, strength, tracks), members in sorted(cells.items()):
        falls = [each.fall for each in members if each.fall is not None]
        mean = float(np.mean(falls)) if falls else float("nan")
        shown = f"{mean:.1f} ({len(falls)})" if falls else "-"
        hard += members if falls and mean >= FALL else []
        found = sum(each.found for each in members)
        told = "yes" if tracks else "no"
        yield f"| {kind} | {strength} | {told} | {len(members)} | {found} | {shown} |"
    found = sum(each.found for each in hard)
    fallen = [each for each in outcomes if each.fall is not None and each.fall >= FALL]
    found_fallen = sum(each.found for each in fallen)
    right = [each for each in outcomes if each.kind == "right"]
    warned = sum(not each.found for each in right)
    yield ""
    yield (
        f"Kinds and strengths with a mean fall of {FALL:g} dB or more: {found} of {len(hard)} "
        f"scenes found. Trained scenes with a fall of {FALL:g} dB or more: {found_fallen} of "
        f"{len(fallen)} found. Correct scenes: {warned} of {len(right)} got a warning."
    )


def main() -> None:
    """Run the search, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scenes", type=Path, nargs="+")
    parser.add_argument("--wrong", type=int, default=240)
    parser.add_argument("--right", type=int, default=400)
    parser.add_argument(
        "--trained", type=int, default=60, help="number of wrong scenes that are trained"
    )
    parser.add_argument("--steps", type=int, default=150)
    parser.add_argument("--size", type=int, default=100, help="longest side of the photos")
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument(
        "--out",
        type=Path,
        help="file of JSON lines to which outcomes are added; the table shows all",
    )
    args = parser.parse_args()
    outcomes: list[Outcome] = []
    seeds = range(args.first, args.first + max(args.wrong, args.right))
    for number, seed in enumerate(seeds):
        path = args.scenes[seed // len(KINDS) % len(args.scenes)]
        made = []
        if number < args.right:
            made.append(right_scene(path, 1_000_000 + seed, args.size))
        if number < args.wrong:
            steps = args.steps if number < args.trained else None
            made.append(wrong_scene(path, seed, args.size, steps))
        outcomes += made
        if args.out is not None:
            with args.out.open("a") as file:
                file.writelines(json.dumps(asdict(each)) + "\n" for each in made)
    if args.out is not None:
        lines = args.out.read_text().splitlines()
        outcomes = [Outcome(**json.loads(line)) for line in lines]
    machine = facts()
    print(f"commit {code()}, {machine['cpu']}, {machine['date']}\n")
    print("\n".join(table(outcomes)))


if __name__ == "__main__":
    main()
