#!/usr/bin/env bash
# Build the wheel, install it in a fresh environment, and use it from an empty folder and on results that were moved.
set -euo pipefail
project=$(cd "$(dirname "$0")/../.." && pwd)
work=$(mktemp -d)
trap 'kill $(jobs -p) 2> /dev/null || true; rm -rf "$work"' EXIT
"${PYTHON:-python3}" -m venv "$work/venv"
unset PYTHONPATH VIRTUAL_ENV
export PATH="$work/venv/bin:$PATH"
pip install --quiet --upgrade pip
pip wheel --quiet --no-deps --wheel-dir "$work" "$project"
pip install --quiet --constraint "$project/constraints.txt" "$work"/hilsplat-*.whl

mkdir "$work/empty folder"
cd "$work/empty folder"
hilsplat run --config config/ci.yaml
hilsplat query synthetic/tiny mug | grep -E "whole|part"
hilsplat init own
test -f own/config/config.yaml -a -f own/config/scenes.tsv

mkdir "$work/moved"
mv results/synthetic/tiny "$work/moved/"
cd "$work"
python -m hilsplat query moved/tiny mug | grep -E "whole|part"
hilsplat view moved/tiny --no-browser > view.log &
for _ in $(seq 120); do
    sleep 0.5
    address=$(grep -oE "http://127[^ ]+" view.log) && break
done
python -c 'import sys, urllib.request as r; print(r.urlopen(sys.argv[1]).read().decode())' "$address" | grep hilsplat > /dev/null
echo "the wheel works"
