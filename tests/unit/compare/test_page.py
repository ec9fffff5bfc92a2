"""The page, the figures and the tables, from folders to files."""

import csv
import re
import shutil
import subprocess
from html.parser import HTMLParser
from pathlib import Path

import pytest
from support.run_folders import RunFolder

from crossgrad_core.cli.main import main
from crossgrad_plugins.compare import app
from crossgrad_plugins.compare.comparison import compared
from crossgrad_plugins.compare.figures import differences
from crossgrad_plugins.compare.figures.differences import draw_differences
from crossgrad_plugins.compare.figures.phases import draw_phases, phases_of
from crossgrad_plugins.compare.load_runs import read_runs
from crossgrad_plugins.compare.options import Options
from crossgrad_plugins.compare.quantity import ClockChoice
from crossgrad_plugins.compare.tables import TABLES, cost_table, csv_tables

SCENE = '<b>&"x"$y_$'
VIEW = "a/<script>alert(1)</script>.jpg"
HELD_OUT = (VIEW, "a/2.jpg", "b/1.jpg", "b/2.jpg")
VOID = {"meta", "link", "img", "br", "wbr", "path", "use", "rect", "col"}


class Reader(HTMLParser):
    """Collects ids, sources and texts, and checks that elements are closed in order."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.ids: list[str] = []
        self.sources: list[str] = []
        self.open: list[str] = []
        self.texts: list[str] = []
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.ids += [value for name, value in attrs if name == "id"]
        self.sources += [value for name, value in attrs if name in {"src", "href", "xlink:href"}]
        assert tag != "script"
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.ids += [value for name, value in attrs if name == "id"]
        self.sources += [value for name, value in attrs if name in {"src", "href", "xlink:href"}]

    def handle_endtag(self, tag):
        if tag not in VOID:
            assert self.open.pop() == tag

    def handle_data(self, data):
        self.texts.append(data)


def compared_in(folder, runs, **options):
    """What is found of runs that are written into a folder."""
    for number, run in enumerate(runs):
        run.write(folder / str(number))
    return compared(read_runs([folder], skip_broken=False), Options(**options))


def test_phases_are_shown_only_if_wall_seconds_are_compared(tmp_path):
    runs = [
        RunFolder(views_per_step=views, seed=seed, cpu_seconds=50.0)
        for views in (1, 2)
        for seed in (0, 1)
    ]
    found = compared_in(tmp_path, runs)
    assert len(phases_of(found)) == 2
    of_cpu = compared(read_runs([tmp_path], skip_broken=False), Options(clock=ClockChoice.CPU))
    assert draw_phases(of_cpu) is None
    assert csv_tables(of_cpu, {})["phases.csv"] == []


def test_an_interval_that_exceeds_the_axis_ends_in_an_arrowhead(tmp_path, monkeypatch):
    kept = []
    monkeypatch.setattr(differences, "drawn", lambda figure, *_: kept.append(figure))
    finals = {(1, 0): 21.0, (1, 1): 21.0, (2, 0): 20.0, (2, 1): 20.4}
    runs = [RunFolder(views_per_step=k, seed=s, final=final) for (k, s), final in finals.items()]
    found = compared_in(tmp_path, runs)
    draw_differences(found)
    (ax,) = kept[0].axes
    low, high = ax.get_xlim()
    (contrast,) = found.ends
    first, last = contrast.estimate.wide
    assert first < low and last > high
    heads = {line.get_marker(): line.get_xdata()[0] for line in ax.lines}
    assert (heads["<"], heads[">"]) == (low, high)


def write_runs(folder: Path) -> None:
    for views in (1, 2):
        for seed in range(2):
            RunFolder(
                scene=SCENE,
                seed=seed,
                views_per_step=views,
                final=20.0 + views + 0.05 * seed,
                held_out=HELD_OUT,
                pictures=HELD_OUT[:3],
                cpu_seconds=55.0,
                evaluations=5,
                environment={"commit": f"{seed}abcdef"},
            ).write(folder / f"{views}-{seed}")


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    folder = tmp_path_factory.mktemp("compare")
    write_runs(folder)
    assert run(str(folder)) == 0
    return folder / "compare"


def run(*arguments: str) -> int:
    with pytest.raises(SystemExit) as ended:
        main(["compare", *arguments])
    return int(ended.value.code or 0)


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_the_page_loads_local_files_only(written):
    text = (written / "index.html").read_text()
    page = Reader(text)
    local = {"data:,", *(f"figures/{path.name}" for path in (written / "figures").iterdir())}
    for source in page.sources:
        assert source.startswith(("#", "data:image/jpeg;base64,")) or source in local, source
    assert not re.search(r"@import|url\((?!#)", text)
    assert len(set(page.ids)) == len(page.ids)
    assert {source[1:] for source in page.sources if source.startswith("#")} <= set(page.ids)
    assert len(text) < 3_000_000


def test_names_of_runs_are_shown_on_the_page_and_not_executed(written):
    texts = "".join(Reader((written / "index.html").read_text()).texts)
    assert SCENE in texts
    assert VIEW in texts


def test_the_first_screen_names_the_winner_and_the_evidence(written):
    texts = " ".join("".join(Reader((written / "index.html").read_text()).texts).split())
    assert "views=2 is better than views=1 by 1.00 dB" in texts
    assert "2 of 2 pairs in favour of views=2, 1 scene" in texts
    assert "Noise floor" in texts


def test_figures_are_written_in_formats_for_papers(written):
    names = {path.name for path in (written / "figures").iterdir()}
    kinds = ["curves_seconds", "curves_cpu_seconds", "curves_views", "curves_steps", "differences"]
    kinds += ["regimes", "profile", "primitives", "phases"]
    assert names == {f"{kind}.{form}" for kind in kinds for form in ("pdf", "png")}
    for path in (written / "figures").iterdir():
        assert path.read_bytes().startswith(b"%PDF" if path.suffix == ".pdf" else b"\x89PNG")
    # Text stays text, in fonts that journals take.
    assert b"/Type3" not in (written / "figures" / "differences.pdf").read_bytes()


def test_every_written_file_is_in_the_list_of_owned_files(written):
    files = {path.relative_to(written).as_posix() for path in written.rglob("*.*")}
    assert files <= {"index.html", *app.OWNED}
    modules = {path.stem for path in Path(app.__file__).parent.glob("figures/*.py")}
    assert modules - {"__init__", "style", "panels", "curves"} <= set(app.DRAWINGS)
    found = compared(read_runs([written.parent], skip_broken=False), Options())
    assert set(csv_tables(found, {})) == set(TABLES)


def test_tables_contain_the_same_numbers_as_the_page(written):
    [end] = [row for row in rows(written / "comparisons.csv") if row["where"] == "at the end"
             and row["figure"] == "psnr"]  # fmt: skip
    assert float(end["difference"]) == pytest.approx(1.0)
    assert (end["pairs"], end["verdict"], end["method"]) == ("2", "different", "mean, Student's t")
    assert {row["arm"] for row in rows(written / "runs.csv")} == {"views=1", "views=2"}
    assert rows(written / "runs.csv")[0]["scene"] == SCENE
    assert all(row["commit"] == f"{row['seed']}abcdef" for row in rows(written / "runs.csv"))
    assert {row["views_per_step"] for row in rows(written / "arms.csv")} == {"1", "2"}
    worst = rows(written / "views.csv")
    assert [float(row["mean"]) for row in worst] == sorted(float(row["mean"]) for row in worst)
    assert rows(written / "phases.csv")[0]["render"] == "25"


def test_the_worst_views_are_shown_with_photo_render_and_error(written):
    text = (written / "index.html").read_text()
    # Of the four held-out views three have a picture: photo, and render and error of two arms.
    assert text.count("data:image/jpeg;base64,") == 3 * 5


@pytest.mark.slow
def test_only_a_comparison_is_replaced_and_the_same_runs_give_the_same_bytes(written, tmp_path):
    runs = [str(path) for path in sorted(written.parent.glob("?-?"))]
    before = {path.name: path.read_bytes() for path in written.rglob("*.*")}
    (written / "figures" / "frontier.pdf").write_bytes(b"of an earlier comparison")
    mine = [written / name for name in ("mine.txt", "my.csv", "figures/my.png", "figures/my.pdf")]
    for path in mine:
        path.write_text("mine")
    assert run(*runs) == 0
    after = {path.name: path.read_bytes() for path in written.rglob("*.*")}
    assert {after.pop(path.name) for path in mine} == {b"mine"}
    assert after == before
    for path in mine:
        path.unlink()
    other = tmp_path / "other"
    other.mkdir()
    (other / "index.html").write_text("<html>somebody's</html>")
    assert run(*runs, "--out", str(other)) == 2
    assert (other / "index.html").read_text() == "<html>somebody's</html>"


def test_costs_are_averaged_over_the_scenes_that_all_arms_have(tmp_path):
    for scene, primitives in (("city", 1000), ("beach", 9000)):
        for views in (1, 2) if scene == "city" else (1,):
            run = RunFolder(scene, views_per_step=views, primitives=primitives)
            run.write(tmp_path / f"{scene}-{views}")
    found = compared(read_runs([tmp_path], skip_broken=False), Options())
    table = cost_table(found)
    titles = [column.title for column in table.columns]
    shown = [titles.index(title) for title in ("arm", "Gaussians at the end", "runs")]
    assert [[row[index] for index in shown] for row in table.rows] == [
        ["views=1", "1,000", "2"],
        ["views=2", "1,000", "1"],
    ]


EVIL = "<img src=x onerror=alert(1)>\"'\n\x1b[31m</title></style><script>alert(1)</script>"


class Elements(HTMLParser):
    """Collects each kind of element with the names of its attributes, and the text."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.kinds: set[tuple[str, ...]] = set()
        self.text = ""
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.kinds.add((tag, *(name for name, _ in attrs)))

    def handle_data(self, data):
        self.text += data


def page_with(folder, capsys, name):
    for seed in range(2):
        for views in (1, 2):
            run = RunFolder(
                scene=name,
                seed=seed,
                views_per_step=views,
                final=20.0 + views,
                held_out=(name, "b"),
                regimes={name: 1.0, "near": -1.0},
            )
            run.write(folder / f"{views}-{seed}")
    options = Options(name=[f"views=1:{name}"])
    app.compare([folder], options, folder / "out", skip_broken=False)
    said = capsys.readouterr()
    return (folder / "out" / "index.html").read_text(), said.out + said.err


@pytest.mark.slow
def test_names_create_no_html_elements_or_attributes(tmp_path, capsys):
    plain, _ = page_with(tmp_path / "plain", capsys, "a harmless name")
    page, said = page_with(tmp_path / "evil", capsys, EVIL)
    found = Elements(page)
    assert found.kinds == Elements(plain).kinds
    assert r"\n\x1b[31m</title></style><script>alert(1)</script>" in found.text
    assert "\x1b" not in page + said
    for table in (tmp_path / "evil" / "out").glob("*.csv"):
        with table.open(newline="", encoding="utf-8") as file:
            assert len({len(row) for row in csv.reader(file, strict=True)}) == 1, table


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("chromium") is None, reason="no Chromium")
def test_a_browser_executes_no_code_from_a_run_name(tmp_path, capsys):
    page_with(tmp_path, capsys, EVIL.replace("alert(1)", "document.title='run'"))
    options = ("--headless", "--no-sandbox", "--disable-gpu", "--virtual-time-budget=2000")
    page = (tmp_path / "out" / "index.html").as_uri()
    shown = subprocess.run(
        ["chromium", *options, "--dump-dom", page], capture_output=True, text=True, check=True
    )
    assert "crossgrad compare" in shown.stdout and "<title>run</title>" not in shown.stdout
