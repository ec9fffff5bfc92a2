#!/bin/sh
# Builds the wheel, installs it into its own environment, and runs the tests outside the checkout's
# import path, so that what is tested is what users install.
#   PYTHON, TEST_VENV: interpreter and environment; TEST_WORKERS: processes
#   CONSTRAINTS: versions of the packages; EXTRAS: lint is what runs ruff and mypy
set -eu
here=$(cd "$(dirname "$0")/.." && pwd)
venv=${TEST_VENV:-$here/.venv-test}
python=${PYTHON:-python3}
constraints=${CONSTRAINTS:-$here/constraints.txt}
extras=${EXTRAS:-test,lint}
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT

fresh=
[ -x "$venv/bin/python" ] || { "$python" -m venv "$venv"; fresh=yes; }
pip() { "$venv/bin/python" -m pip --quiet --disable-pip-version-check "$@"; }
# The pip of a Python from 2023 takes twice the time for each package.
pip install --upgrade --constraint "$here/constraints.txt" pip build hatchling
# Bytecode is made when a module is imported, in the tests' environment: most never are.
unset PYTHONDONTWRITEBYTECODE
pip install --no-compile --no-deps --constraint "$constraints" torch &
torch=$!
"$venv/bin/python" "$here/tests/beside_torch.py" "$extras" >"$work/needs.txt"
pip install --no-compile --no-warn-conflicts --constraint "$constraints" --requirement "$work/needs.txt"
"$venv/bin/python" -m build --wheel --no-isolation --outdir "$work/dist" "$here" >"$work/build.log" 2>&1 ||
    { cat "$work/build.log"; exit 1; }
wheel=$(ls "$work"/dist/crossgrad-*.whl)
wait "$torch"
pip install --no-compile --constraint "$constraints" "crossgrad[$extras] @ file://$wheel"
# The version stays the same while the code changes: the wheel itself must always be renewed.
[ -n "$fresh" ] || pip install --no-compile --force-reinstall --no-deps "$wheel"

cd "$work"
types=
case ",$extras," in *,lint,*)
    "$venv/bin/ruff" check "$here"
    "$venv/bin/ruff" format --check "$here"
    # Beside the tests: it has one thread.
    (cd "$here" && exec "$venv/bin/mypy") >"$work/types.log" 2>&1 &
    types=$!
    ;;
esac
# tests/conftest.py says which tests stay together, and which come first.
"$venv/bin/python" -m pytest --numprocesses "${TEST_WORKERS:-auto}" --no-loadscope-reorder --quiet \
    --rootdir "$here" --config-file "$here/pyproject.toml" "$here/tests" "$@" && tests=0 || tests=$?
[ -z "$types" ] || wait "$types" || { cat "$work/types.log"; exit 1; }
exit "$tests"
