#!/bin/sh
# Trains with this checkout and with another commit of it, and says what differs (same_bits.py).
#   PYTHON: an environment with this checkout installed; BASE: the other commit
# Arguments go to benchmarks/same_bits.py.
set -eu
here=$(cd "$(dirname "$0")/.." && pwd)
python=$(cd "$(dirname "$PYTHON")" && pwd)/$(basename "$PYTHON")
work=$(mktemp -d)
trap 'git -C "$here" worktree remove --force "$work/base" 2>/dev/null || true; rm -rf "$work"' EXIT

git -C "$here" worktree add --quiet --detach "$work/base" "$BASE"
# The same packages, another crossgrad: the environment of this one stands behind that of the base.
"$python" -m venv --without-pip "$work/venv"
"$python" -c 'import site; print(site.getsitepackages()[0])' \
    >"$("$work/venv/bin/python" -c 'import site; print(site.getsitepackages()[0])')/behind.pth"
"$python" -m pip --quiet --disable-pip-version-check --python "$work/venv/bin/python" \
    install --no-deps --editable "$work/base"
"$python" "$here/benchmarks/same_bits.py" "$work/venv/bin/python" "$python" --out "$work/runs" "$@"
