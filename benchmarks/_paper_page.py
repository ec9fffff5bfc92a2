"""The page docs/results/paper.md: all tables and claims, with our results and verdicts."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from math import isnan
from statistics import fmean

from _paper_data import Check, Claims, Expected, Pairing, Reading, Table, Tables, values
from _paper_runs import CAMERAS, Results, number, probe_rows, probed
from _paper_verdicts import PSNR, Answer, Outcome, answers, figure_of, paired

from crossgrad_plugins.compare.contrasts import judged
from crossgrad_plugins.compare.narrative import claim
from crossgrad_plugins.compare.ranking import noise, standings
from crossgrad_plugins.compare.run import Run

#: Arms whose runs measure their gradients with the observer `diagnostics`.
WATCHED = ("one view, 2x stretched", "symmetric")
#: Quantity that is equal in a comparison -> the arm with two views and the arm with one view.
EQUAL = {
    "equal steps": ("two random views", "one view, 1x"),
    "equal views": ("two random views", "one view, 2x stretched"),
    "equal seconds": ("two random views, 60 s", "one view, 60 s"),
    "equal views, published rates": (
        "two random views, published rates",
        "one view, 2x stretched, published rates",
    ),
}
#: Differences in the paper below this value, in dB, count as equal.
_SAME = 0.1
_HEAD = "| {} | the paper | command | ours | verdict |"


def page(claims: Claims, results: Results, tables: Tables, extra: Sequence[str] = ()) -> str:
    """Return the page.

    Args:
        claims: The paper's claims.
        results: The results of the grids.
        tables: The values of the paper.
        extra: Pairs of arms of the other backbones, by backbone.
    """
    blocks = [_table(table, claims, results, tables) for table in claims.tables]
    sections = [
        (section.title, _section(section.claims, results, tables)) for section in claims.sections
    ]
    outcomes = Counter(
        answer.outcome
        for _, found in (*blocks, *(found for _, found in sections))
        for answer in found
    )
    lines = [
        *_opening(claims, results, outcomes),
        "## Tables of the paper",
        "",
        *(line for text, _ in blocks for line in text),
        "## Claims of the paper, and further questions",
        "",
        *(line for title, (text, _) in sections for line in (f"### {title}", "", *text, "")),
        *_second_view(results),
        *_other_backbones(results, extra),
        *_by_scene(results),
        *_trajectories(results),
        *_noise(results),
    ]
    return "\n".join(lines).rstrip() + "\n"


def _opening(claims: Claims, results: Results, outcomes: Mapping[Outcome, int]) -> Iterator[str]:
    planned = sum(len(each) for each in results.planned.values())
    finished = sum(len(each) for each in results.runs.values())
    yield from (
        "# The paper, row by row",
        "",
        f"This page tests each table row and each claim of {claims.source} on our scenes. `make "
        "paper` trains the missing runs and writes this page. Do not edit it.",
        "",
        f"**{finished:,} of {planned:,} runs have finished.** Verdicts: "
        + ", ".join(f"{each.value} {outcomes.get(each, 0)}" for each in Outcome)
        + ".",
        "",
        "## How to read the tables",
        "",
        "- Our figures are differences in PSNR after colour correction (`psnr_cc`, "
        "[metrics](../metrics.md)), in dB: the first arm minus the second arm.",
        "- Each difference has its 95 % interval and its number of pairs n. A pair is two runs on "
        "one scene with one seed. The statistics are the same as in "
        "[`crossgrad compare`](../compare.md).",
        "- `plain` is the difference in plain PSNR. If the exposure of a scene is uneven, plain "
        "PSNR mostly depends on the guessed exposure of held-out photos. Different arms "
        "then have a similar plain PSNR.",
        "- A claim that two arms are equal holds if the 90 % interval lies within the margin of "
        "0.1 dB.",
        "- A claim that one arm is better holds if the 95 % interval excludes zero.",
        "- In a table with more than five comparisons, the p-values are corrected together.",
        "- Each arm uses its own best factor of the learning rates. The factor was chosen on a "
        "seed that does not count here. An arm without its own tuning uses the factor of an arm "
        "with the same number of views per step (`benchmarks/paper_data/plan.yaml`).",
        "",
        "| remark in the verdict column | meaning |",
        "|---|---|",
        "| surely otherwise on SCENE | The 95 % interval of this scene alone contradicts the "
        "pooled result, so the verdict is never `holds`. The interquartile mean of 12 pairs "
        "ignores most of a scene that differs. |",
        "| by less than the margin | The difference is certain, but smaller than the margin. |",
        "| sure by itself, but not beside the other comparisons of its table | The interval "
        "decides the claim, but not after the correction for all comparisons of the table. |",
        "| n \u2265 N pairs needed to tell 0.1 dB at this noise | At least N pairs are "
        "needed to detect a difference of 0.1 dB. |",
        "",
        *_machines(results),
        "## Recipes for the paper's scenes",
        "",
        "Use these recipes if you have the scenes of the paper.",
        "",
        *(f"- {name}: {text}" for name, text in claims.recipes.items()),
        "",
    )


def _machines(results: Results) -> Iterator[str]:
    runs = [run for by in results.runs.values() for run in by.values()]
    code: dict[str, set[str]] = {}
    for run in runs:
        if env := run.summary.get("environment"):
            machine = f"{env.get('cpu')}, crossgrad {env.get('crossgrad')}"
            code.setdefault(machine, set()).add(str(env.get("commit") or "not known"))
    facts = [f"{machine} (commits: {', '.join(sorted(own))})" for machine, own in code.items()]
    if facts:
        spent = [run.number("cpu_seconds") or run.number("train_seconds") or 0.0 for run in runs]
        hours = f"Training took {sum(spent) / 3600:.1f} core hours."
        yield f"Machines: {'; '.join(sorted(facts))}. {hours}"
        yield ""


def _table(
    table: Table, claims: Claims, results: Results, tables: Tables
) -> tuple[list[str], list[Answer]]:
    methods = tables[table.id]
    checks = {
        method: row.check(_expected(tables, table, method)) for method, row in table.rows.items()
    }
    found = answers(list(checks.values()), results, tables)
    lines = [f"### {table.title} (`{table.id}`)", ""]
    lines += [table.note, ""] if table.note else []
    lines += [_HEAD.format("row"), "|---" * 5 + "|"]
    for method in methods:
        if method == table.reference:
            text = f"{_figures(tables, table.id, method)}; the reference of the other rows"
            lines.append(_row(method, text, "", Answer(Outcome.UNTESTABLE)))
        elif method in checks:
            answer = found[list(checks).index(method)]
            text = _published(tables, table, method)
            lines.append(_row(method, text, _command(checks[method], results), answer))
    metrics = dict.fromkeys(each.metric for figures in methods.values() for each in figures)
    itself = Answer(Outcome.UNTESTABLE, "", claims.untestable)
    text = f"the absolute figures ({', '.join(metrics)})"
    lines += [_row("all", text, "", itself), ""]
    return lines, found


def _row(name: str, text: str, command: str, answer: Answer) -> str:
    verdict = answer.outcome.value if command or answer.detail else ""
    detail = f": {answer.detail}" if answer.detail else ""
    return f"| {name} | {text} | {command} | {answer.figure} | {verdict}{detail} |"


def _section(
    section: Sequence[Check], results: Results, tables: Tables
) -> tuple[list[str], list[Answer]]:
    found = answers(section, results, tables)
    lines = [_HEAD.format("place in the paper"), "|---" * 5 + "|"]
    for each, answer in zip(section, found, strict=True):
        where, says = getattr(each, "where", ""), getattr(each, "says", "")
        lines.append(_row(where, says, _command(each, results), answer))
    return lines, found


def _command(check: Check, results: Results) -> str:
    """Return the command that runs the arms of a check."""
    if check.arithmetic is not None:
        return "`python benchmarks/paper.py page`"
    grids = dict.fromkeys(results.grids[arm] for arm in check.arms if arm in results.grids)
    return f"`python benchmarks/paper.py run --only {','.join(grids)}`" if grids else ""


def _expected(tables: Tables, table: Table, method: str) -> Expected:
    """Return the relation between a row and the table's reference in the paper's numbers."""
    found = _differences(tables, table, method)
    mean = fmean(found.values()) if found else 0.0
    if abs(mean) < _SAME:
        return "equal"
    return "better" if mean > 0 else "worse"


def _differences(tables: Tables, table: Table, method: str) -> dict[str, float]:
    """Return the PSNR minus the PSNR of the reference, for each scene.

    If a table contains gains, its numbers already are these differences.
    """
    gains = values(tables, table.id, method, "PSNR_gain")
    if gains or table.reference is None:
        return gains
    own = values(tables, table.id, method, "PSNR")
    reference = values(tables, table.id, table.reference, "PSNR")
    return {scene: own[scene] - reference[scene] for scene in own if scene in reference}


def _published(tables: Tables, table: Table, method: str) -> str:
    found = _differences(tables, table, method)
    if not found:
        return _figures(tables, table.id, method)
    shown = ", ".join(f"{scene} {value:+.2f}" for scene, value in found.items())
    return f"{shown}: {_expected(tables, table, method)} (mean {fmean(found.values()):+.2f})"


def _figures(tables: Tables, table: str, method: str) -> str:
    figures = [each for each in tables[table][method] if each.metric not in {"SSIM", "LPIPS"}]
    several = len({each.metric for each in figures}) > 1
    return ", ".join(
        f"{each.scene}{f' {each.metric}' if several else ''} "
        f"{'none' if each.value is None else format(each.value, 'g')}"
        for each in figures
    )


def _second_view(results: Results) -> Iterator[str]:
    """Yield a table of the gain of a second view, at equal steps, views and seconds."""
    yield from (
        "## Gain of the second view by scene",
        "",
        "The p-values of all rows are corrected together. With this many rows, an interval of "
        "three pairs can exclude zero by chance.",
        "",
    )
    contrasts = {
        (scene, name): paired(Pairing(first=a, second=b, scenes=(scene,)), results)
        for scene in _scenes(results)
        for name, (a, b) in EQUAL.items()
    }
    # The p-values of all rows of the table are corrected together.
    whole = [
        key
        for key, each in contrasts.items()
        if each.estimate is not None and not _lacking(results, *key)
    ]
    verdicts = dict(zip(whole, judged(contrasts[key] for key in whole), strict=True))
    yield from ("| scene | at | two views minus one | by regime | verdict |", "|---" * 5 + "|")
    for (scene, name), each in contrasts.items():
        regimes = _regimes(results, EQUAL[name], scene)
        verdict = (
            verdicts[scene, name].verdict.value
            if (scene, name) in verdicts
            else f"{Outcome.NOT_RUN.value}{_lacking(results, scene, name)}"
        )
        yield f"| {scene} | {name} | {figure_of(each)} | {regimes} | {verdict} |"
    yield ""


def _lacking(results: Results, scene: str, name: str) -> str:
    """Return the number of finished pairs if a comparison is unfinished, else an empty text."""
    wanted, missing = results.missing(EQUAL[name], (scene,))
    if not wanted:
        return ": in no grid"
    return f": {wanted - missing} of {wanted} pairs so far" if missing else ""


def _regimes(results: Results, arms: tuple[str, str], scene: str) -> str:
    runs = [run for (at, _), run in results.runs.get(arms[0], {}).items() if at == scene]
    names = sorted({name for run in runs for name in run.results.regimes})
    pairing = Pairing(first=arms[0], second=arms[1], scenes=(scene,))
    found = [(name, paired(pairing, results, regime=name).estimate) for name in names]
    return ", ".join(f"{n} {PSNR.difference(e.center)}" for n, e in found if e is not None)


def _scenes(results: Results) -> list[str]:
    return sorted({scene for pairs in results.planned.values() for scene, _ in pairs})


def _other_backbones(results: Results, extra: Sequence[str]) -> Iterator[str]:
    yield from (
        "## Other backbones",
        "",
        "Each backbone is trained with the two methods that were best on vanilla.",
        "",
    )
    table = standings({arm: results.runs.get(arm, {}) for arm in extra}, PSNR)
    if not any(table.values()):
        yield from ("not run", "")
        return
    yield from ("| arm | PSNR by scene |", "|---|---|")
    for arm, by in table.items():
        cells = ", ".join(
            f"{scene} {PSNR.shown(each.mean)}"
            + ("" if isnan(each.spread) else f" ± {each.spread:.2f}")
            + f" (n = {each.seeds})"
            for scene, each in by.items()
        )
        yield f"| {arm} | {cells or Outcome.NOT_RUN.value} |"
    yield ""
    for contrast in judged(
        paired(Pairing(first=first, second=second), results)
        for first, second in zip(extra[::2], extra[1::2], strict=True)
    ):
        yield f"- {claim(contrast)} ({figure_of(contrast)})"
    yield ""


def _by_scene(results: Results) -> Iterator[str]:
    """Yield a table of cameras, gradients and gains with one row per scene."""
    yield from ("## Cameras and gradients by scene", "")
    watched = results.runs.get(WATCHED[0], {})
    if not any(probe_rows(run) for run in watched.values()):
        yield from ("not run", "")
        return
    yield from (
        "- Bimodality is Sarle's coefficient. The first number is its finite-sample form, which "
        "grows with the number of views. The second number uses plain moments. A uniform sample "
        "has 0.555.",
        "- Var(r)/mean(r)^2 is the relative variance of the cameras' distances: radial distance, "
        "then depth.",
        "- The conflict rate and sigma_b^2/sigma_w^2 use the gradients of all blocks together. "
        "They and the exponent are means over probes and seeds of runs with one view per step.",
        "",
        "| scene | quantity: bimodality | Var(r)/mean(r)^2 | conflict rate | sigma_b^2/sigma_w^2 "
        "| exponent of positions | projection minus random pairs |",
        "|---" * 7 + "|",
    )
    for scene in sorted({scene for scene, _ in watched}):
        runs = [run for (at, _), run in sorted(watched.items()) if at == scene]
        cells = (
            *_cameras(runs[0]),
            _mean(runs, Reading(column="conflict_rate", block="all")),
            _mean(runs, Reading(column="rho", block="all")),
            _mean(runs, Reading(column="exponent_depth", block="means")),
            figure_of(paired(_gain(scene), results)) or Outcome.NOT_RUN.value,
        )
        yield f"| {scene} | {' | '.join(cells)} |"
    yield ""


def _gain(scene: str) -> Pairing:
    return Pairing(first="symmetric", second="two random views", scenes=(scene,))


def _cameras(run: Run) -> tuple[str, str]:
    rows = probe_rows(run, CAMERAS)
    shown = [
        f"{row['quantity']}: {_cell(row, 'bimodality_sample')} / "
        f"{_cell(row, 'bimodality_population')} (n = {row['views']})"
        for row in rows
    ]
    spread = [_cell(r, "relative_variance") for r in rows if r["relative_variance"]]
    return "; ".join(shown), "; ".join(spread)


def _mean(runs: Sequence[Run], reading: Reading) -> str:
    known = [value for run in runs if (value := probed(run, reading)) is not None]
    return f"{fmean(known):.3g}" if known else ""


def _cell(row: Mapping[str, str], column: str) -> str:
    value = number(row, column)
    return "" if value is None else f"{value:.3g}"


def _trajectories(results: Results) -> Iterator[str]:
    """Yield a table of conflicts, ratios and variances during training, one row per probe."""
    yield from ("## Trajectories", "")
    rows = [line for arm in WATCHED for line in _trajectory(arm, results)]
    if not rows:
        yield from ("not run", "")
        return
    yield from (
        "Each row is one probe. A probe measures gradients at frozen parameters.",
        "",
        "- Conflict rates and ratios are means over seeds.",
        "- Variances and their 95 % intervals are from the first seed. The intervals treat the "
        "probed views as a sample.",
        "- The first conflict rate joins all blocks into one vector. The rate in brackets is the "
        "mean over single blocks.",
        "- A negative sigma_b^2 is an estimate that does not clearly differ from 0.",
        "",
        "| arm | scene | step | conflict rate | ratio of positions | ratio of opacity + DC "
        "| sigma_w^2 | sigma_b^2 | sigma_b^2/sigma_w^2 "
        "| sigma_b^2/sigma_w^2, Adam's metric |",
        "|---" * 10 + "|",
        *rows,
        "",
    )


def _trajectory(arm: str, results: Results) -> Iterator[str]:
    runs = results.runs.get(arm, {})
    for scene in sorted({scene for scene, _ in runs}):
        own = [run for (at, _), run in sorted(runs.items()) if at == scene]
        tables = [rows for run in own if (rows := probe_rows(run))]
        for step in sorted({int(row["step"]) for row in tables[0]} if tables else ()):
            cells = _probe([[r for r in rows if int(r["step"]) == step] for rows in tables], own[0])
            yield f"| {arm} | {scene} | {step} | {' | '.join(cells)} |"


def _probe(tables: Sequence[Sequence[Mapping[str, str]]], run: Run) -> Iterator[str]:
    """Yield the cells of one probe. `tables` contains the rows of the probe for each seed."""

    def over_seeds(column: str, block: str) -> str:
        reading = Reading(column=column, block=block)
        known = [v for rows in tables if (v := probed(run, reading, rows)) is not None]
        return f"{fmean(known):.3g}" if known else ""

    yield f"{over_seeds('conflict_rate', 'all')} ({over_seeds('conflict_rate', 'each')})"
    yield over_seeds("ratio_of_means", "means")
    yield over_seeds("ratio_of_means", "opacities+f_dc")
    for metric, columns in (("plain", ("sigma_w2", "sigma_b2", "rho")), ("adam", ("rho",))):
        row = next((r for r in tables[0] if r["block"] == "all" and r["metric"] == metric), {})
        yield from (_with_interval(row, column) for column in columns)


def _with_interval(row: Mapping[str, str], column: str) -> str:
    """Return an estimate with its 95 % interval.

    For a negative estimate, the text says that there is no interval.
    """
    value, low, high = (row.get(f"{column}{end}", "") for end in ("", "_low", "_high"))
    # Tables from before 2026-11-25 contain [0, 0] if the estimate is below 0.
    if value and float(value) < 0.0 and not any(float(end) for end in (low, high) if end):
        return f"{_cell(row, column)} (none, the estimate is below 0)"
    if not low or not high:
        return _cell(row, column)
    return f"{_cell(row, column)} ({float(low):.3g} to {float(high):.3g})"


def _noise(results: Results) -> Iterator[str]:
    yield from (
        "## Noise",
        "",
        "Standard deviation of `psnr_cc` over seeds, pooled over all arms.",
        "",
    )
    found = noise(standings(results.runs, PSNR), results.runs)
    if not found:
        yield "not run"
        return
    yield from ("| scene | dB | degrees of freedom |", "|---|---|---|")
    yield from (f"| {scene} | {sd:.3f} | {free} |" for scene, (sd, free) in found.items())
