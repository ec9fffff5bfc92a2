"""A plain run imports only what it uses."""

import subprocess
import sys

import pytest
from support.scenes import write_tiny_scene

PROGRAM = """
import sys
from crossgrad_core.cli.main import main
try:
    main(sys.argv[1:])
except SystemExit as ended:
    assert not ended.code, ended.code
print("\\n".join(sorted(sys.modules)))
"""
OURS = "crossgrad_plugins."
#: What a run on a COLMAP scene on a CPU does not use: a module, and what is below it.
UNUSED = (
    *(
        f"readers.{name}"
        for name in (
            *("blender", "matrixcity", "metashape", "nerfstudio", "opensfm", "photos_alone"),
            *("realitycapture", "uc_gs", "_cameras", "_raw", "place.files"),
            *("_transforms", "_xml"),
        )
    ),
    *("rasterizers.gpu", "rasterizers.gsplat_cuda", "rasterizers.gswarp_cuda"),
    *("rasterizers.torch_reference", "rasterizers.reference"),
    "metrics.lpips_distance",
    *(f"georeference.{name}" for name in ("ellipsoid", "frames", "on_earth", "projection")),
    *("prepare", "compare", "sweep", "diagnostics", "authoring"),
)


@pytest.fixture(scope="module")
def imported(tmp_path_factory):
    folder = tmp_path_factory.mktemp("lean")
    scene = write_tiny_scene(folder / "scene", views=4, width=32, height=24, points=60)
    arguments = ["run", str(scene), "--steps", "2", "--out", str(folder / "run"), "--quiet"]
    command = [sys.executable, "-c", PROGRAM, *arguments]
    ended = subprocess.run(command, capture_output=True, text=True, check=True)
    return set(ended.stdout.splitlines())


@pytest.mark.parametrize("unused", UNUSED)
def test_a_run_on_a_colmap_scene_does_not_import_unused_modules(imported, unused):
    assert f"{OURS}readers.colmap" in imported
    module = OURS + unused
    assert not [each for each in imported if each == module or each.startswith(f"{module}.")]


def test_each_module_of_the_import_list_exists(imported):
    from support.imports import modules

    assert {OURS + unused for unused in UNUSED} <= modules().keys()
