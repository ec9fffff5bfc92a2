"""Export of the Gaussians of a trained run to files."""

from pathlib import Path
from typing import Final

from crossgrad_core.contract.georeference import INPUT, check_coordinates
from crossgrad_core.contract.slots.exporter import Exporter
from crossgrad_core.errors import UserError
from crossgrad_core.registry.entries import build, entries, find
from crossgrad_core.run.export import Exported, ExportOptions, described, export_scene, georef_of
from crossgrad_core.run.postprocess.open_options import AS_IT_IS, Opens
from crossgrad_core.run.postprocess.output_paths import own_name, writing
from crossgrad_core.run.results.panels import flat_names
from crossgrad_core.run.results.summary import FILE as SUMMARY
from crossgrad_core.run.results.summary import add_export, summarised_step
from crossgrad_core.run.session import CLOUD
from crossgrad_core.system.check_writable import check_file, check_new
from crossgrad_core.system.checksums import relisted
from crossgrad_core.system.files import clear_leftovers
from crossgrad_core.training.setup import Setup
from crossgrad_core.wording import one_line

#: Suffixes of Gaussian file formats of other programs.
_OF_OTHERS: Final = frozenset({"ksplat", "rad"})


def export(
    folder: Path,
    *,
    file_format: str | None = None,
    out: Path | None = None,
    options: ExportOptions = ExportOptions(),  # noqa: B008 - it is frozen
    how: Opens = AS_IT_IS,
) -> None:
    """Write the trained scene like `exported`, and print a description of the file."""
    path, content = exported(folder, file_format=file_format, out=out, options=options, how=how)
    for line in described(content, path):
        print(line)  # noqa: T201
    print(f"{content.gaussians:,} Gaussians written to {one_line(path)}")  # noqa: T201


def exported(
    folder: Path,
    *,
    file_format: str | None = None,
    out: Path | None = None,
    options: ExportOptions = ExportOptions(),  # noqa: B008 - it is frozen
    how: Opens = AS_IT_IS,
) -> tuple[Path, Exported]:
    """Write the trained scene to a file that viewers open.

    Args:
        folder: The run's folder.
        file_format: Name of an exporter; None for the exporter of the run.
        out: The file; by default a file in the run's folder. The default name is never the name of
            a file that summary.json describes with another content.
        options: The options of the export.
        how: The options for opening the run.

    Returns:
        The file, and a description of its content.

    Raises:
        UserError: There is no such format, the folder is not a run, the run has no checkpoint, the
            file exists, there is no such view or nothing to bake for it, the scene cannot be put
            into these coordinates, or the run is training and `out` is not given.
    """
    if options.coordinates is not None:
        check_coordinates(options.coordinates)
    if file_format is not None:
        find("exporters", file_format)
    with writing(folder, out, "exporting"):
        if out is not None:
            if not out.is_dir() or _writes_folder(file_format):
                check_new(out, georef_of(out))
            check_file(out)
            clear_leftovers(out.parent, shared=True)
        setup, state = how.open(folder)
        # If the exporter is the run's exporter, use the options of the run.
        exporter = setup.selection.exporter
        if file_format not in {None, setup.selection.names["exporter"]}:
            exporter = build(Exporter, str(file_format), {})
        _check_name(out, exporter)
        camera = options.camera
        if camera is not None and setup.backbone.plain:
            raise UserError(
                f"--camera has no effect: backbone {setup.selection.names['backbone']} "
                "exports the same file for every view",
                where="--camera",
                todo="leave --camera out",
            )
        path = out or _default_path(folder, setup, state.step, exporter, file_format, options)
        own = () if out else (path.name, georef_of(path).name, SUMMARY)
        with relisted(folder, *own):
            content = export_scene(setup, state, path, exporter, options)
            if out is None and summarised_step(folder) == state.step:
                add_export(folder, path.name, content.as_data())
            return path, content


def _default_path(
    folder: Path,
    setup: Setup,
    step: int,
    exporter: Exporter,
    file_format: str | None,
    options: ExportOptions,
) -> Path:
    """Return the path of an export below the folder of its run.

    Only the export with defaults to a file replaces the file of an earlier export of this step.
    """
    words = [CLOUD, *_differences(setup, options)]
    kind = f".{exporter.suffix}"
    if not exporter.suffix:
        kind = f"_{file_format or setup.selection.names['exporter']}"
    name = f"{'_'.join(words)}{kind}"
    if words == [CLOUD] and exporter.suffix:
        return folder / own_name(folder, name, step)
    check_new(folder / name)
    return folder / name


def _writes_folder(file_format: str | None) -> bool:
    """Return True if a format is known to be a folder; None is the unknown format of the run."""
    return file_format is not None and not build(Exporter, file_format, {}).suffix


def _check_name(out: Path | None, exporter: Exporter) -> None:
    """Refuse an output file whose name ends like a file of another format."""
    if out is None:
        return
    # A file must not have the suffix of another format.
    suffix = out.suffix.lower().removeprefix(".")
    known = {build(Exporter, name, {}).suffix for name in entries("exporters")} | _OF_OTHERS
    if not suffix or suffix == exporter.suffix or suffix not in known:
        return
    raise UserError(
        "the name of the output file ends like a file of another format",
        where=f"--out {out}",
        expected=f"a name that ends in .{exporter.suffix}"
        if exporter.suffix
        else "the name of a new folder",
        todo="rename it, or choose another --format (`crossgrad plugins list` shows them)",
    )


def _differences(setup: Setup, options: ExportOptions) -> list[str]:
    """Return the parts of a file name that tell an export from the export with defaults."""
    words = {
        "camera": options.camera and _flat(setup, options.camera),
        "coordinates": options.coordinates not in {None, INPUT}
        and str(options.coordinates).replace(":", "-"),
        "up": options.up and f"{options.up}-up",
        "degree": options.sh_degree is not None and f"sh{options.sh_degree}",
        "crop": options.crop and "crop",
        "number": options.max_gaussians and f"{options.max_gaussians}",
        "response": not options.baked and "unbaked",
    }
    return [word for word in words.values() if word]


def _flat(setup: Setup, camera: str) -> str:
    """Return a view's name as a part of a file name; an unknown view is refused later."""
    return flat_names([view.name for view in setup.scene.views]).get(camera, "view")
