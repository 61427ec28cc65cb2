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
hilsplat view moved/tiny --port 8471 --no-browser &
for _ in $(seq 60); do
    sleep 0.5
    page=$(python -c 'import urllib.request as r; print(r.urlopen("http://127.0.0.1:8471/").read().decode())' 2> /dev/null) && break
done
grep -q hilsplat <<< "$page"
echo "the wheel works"
