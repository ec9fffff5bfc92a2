#!/bin/sh
# Runs the tests against the wheel on the other Pythons that pyproject.toml names, and on the lowest
# Python with the lowest versions of all packages. Arguments go to pytest.
#   COMPAT_VENVS: where the environments are kept (they need about 20 GB on Linux, most of it CUDA
#                 libraries that torch brings there); TEST_WORKERS: processes per run (1).
set -eu
here=$(cd "$(dirname "$0")/.." && pwd)
venvs=${COMPAT_VENVS:-$here/.venv-compat}
report=""
failed=0
mkdir -p "$venvs"

find_python() { # VERSION -> path of an interpreter, empty where there is none
    for candidate in "python$1" "$HOME"/.pyenv/versions/"$1".*/bin/python; do
        if "$candidate" -c 'import sys; raise SystemExit("%d.%d" % sys.version_info[:2] != sys.argv[1])' \
            "$1" 2>/dev/null; then
            command -v "$candidate"
            return
        fi
    done
}

check() { # NAME VERSION CONSTRAINTS [arguments of pytest]
    name=$1
    python=$(find_python "$2")
    constraints=$3
    shift 3
    if [ -z "$python" ]; then
        line="left out: there is no python in version ${name%% *}"
    elif PYTHON="$python" TEST_VENV="$venvs/$(echo "$name" | tr ' ' -)" CONSTRAINTS="$constraints" \
        EXTRAS=test TEST_WORKERS="${TEST_WORKERS:-1}" sh "$here/tests/run.sh" "$@"; then
        line="passed"
    else
        line="FAILED"
        failed=1
    fi
    report="$report
  Python $name: $line"
}

lowest=$(find_python 3.11)
[ -z "$lowest" ] || "$lowest" "$here/tests/lowest.py" >"$venvs/lowest.txt"
# Old packages warn about what newer ones beside them deprecate.
check "3.11 lowest" 3.11 "$venvs/lowest.txt" -W default::DeprecationWarning "$@"
check "3.12" 3.12 "$here/constraints.txt" "$@"
check "3.13" 3.13 "$here/constraints.txt" "$@"
echo "compatibility:$report"
exit $failed
