#!/usr/bin/env bash
# Set-up and the two commands of this project: ./run.sh demo, ./run.sh test (and ./run.sh setup alone, and for who
# changes it ./run.sh bench smoke|gate|full and ./run.sh next).
# Installs into .venv, and a libLLVM (17 or newer) and libatomic from the system's packages where they are missing. A
# second run is quick.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")"

say() { printf '%s\n' "run.sh: $*" >&2; }
die() { say "$*"; exit 2; }

as_root() {
  if [ "$(id -u)" = 0 ]; then "$@"; elif command -v sudo >/dev/null; then sudo "$@"; else return 127; fi
}

apt_install() {
  command -v apt-get >/dev/null || return 1
  as_root env DEBIAN_FRONTEND=noninteractive apt-get update -qq >&2 || true
  for package in "$@"; do
    as_root env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "$package" >&2 && return 0
  done
  return 1
}

find_python() {
  for name in python3 python3.14 python3.13 python3.12 python3.11; do
    if command -v "$name" >/dev/null && "$name" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then
      echo "$name"
      return 0
    fi
  done
  return 1
}

make_venv() {
  local python
  python=$(find_python) || die "Python 3.11 or newer is needed: install it (Debian/Ubuntu: sudo apt-get install python3 python3-venv)"
  if ! "$python" -m venv .venv 2>/dev/null; then
    rm -rf .venv
    apt_install "python$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])')-venv" python3-venv ||
      die "$python cannot make virtual environments: install its venv module (Debian/Ubuntu: sudo apt-get install python3-venv)"
    "$python" -m venv .venv
  fi
}

setup() {
  local stamp=.venv/.installed-from want
  want=$(cat pyproject.toml .ci/requirements.lock | sha256sum | cut -d' ' -f1)
  if [ ! -x .venv/bin/python ] || [ "$(cat "$stamp" 2>/dev/null)" != "$want" ]; then
    say "installing into .venv (once)"
    [ -x .venv/bin/python ] || make_venv
    .venv/bin/python -m pip install --quiet --disable-pip-version-check -c .ci/requirements.lock -e '.[test]'
    echo "$want" >"$stamp"
  fi
  if ! .venv/bin/python -c 'import drjit' >/dev/null 2>&1; then
    say "installing libatomic, which Dr.Jit needs, from the system's packages"
    apt_install libatomic1 && .venv/bin/python -c 'import drjit' || die "Dr.Jit cannot be loaded: see above"
  fi
  if ! .venv/bin/python -m rsgen.device.backend >/dev/null 2>&1; then
    say "installing libLLVM from the system's packages"
    apt_install libllvm19 libllvm20 libllvm18 libllvm17 || true
    .venv/bin/python -m rsgen.device.backend >/dev/null || exit 2
  fi
}

demo() {
  .venv/bin/rsgen render demo --out out/demo
  .venv/bin/rsgen verify out/demo
  .venv/bin/rsgen preview out/demo
  .venv/bin/rsgen preview out/demo --frame 20
  .venv/bin/rstrack track out/demo --out out/demo_track
  .venv/bin/rstrack track out/demo --out out/demo_track_gs --method gs-pg
  .venv/bin/rstrack report out/demo_track --out out/demo_track/plot.png
  .venv/bin/rstrack report out/demo_track
  .venv/bin/rstrack evaluate out/demo out/demo_track --against out/demo_track_gs
}

test_all() {
  # Beside all the rest, which leaves it enough of the cores: what it says is shown at the end.
  local types told status=0
  told=$(mktemp)
  .venv/bin/mypy >"$told" 2>&1 &
  types=$!
  command -v chromium >/dev/null || command -v google-chrome >/dev/null || apt_install chromium ||
    say "no chromium: the tests of the report in a browser are skipped"
  .venv/bin/ruff check .
  .venv/bin/ruff format --check .
  local contracts
  contracts=$(.venv/bin/lint-imports --no-cache) || { say "$contracts"; return 1; }
  # One thread per process for the small solves; two processes share the rendering cores. Files in their own order: the
  # slowest have few tests, and would come last and alone. Compiled modules are kept, for the processes that tests start.
  env -u PYTHONDONTWRITEBYTECODE OPENBLAS_NUM_THREADS=1 \
    .venv/bin/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder "$@" || status=$?
  wait "$types" || status=$?
  cat "$told"
  rm -f "$told"
  return "$status"
}

# The tests with the newest Mitsuba, where pyproject.toml does not allow it yet: in a copy, so that .venv stays as it is.
next_mitsuba() {
  local bound newest copy
  bound=$(sed -n 's/.*"mitsuba>=[0-9.]*,<\([0-9.]*\)".*/\1/p' pyproject.toml)
  newest=$(.venv/bin/python -m pip index versions --pre mitsuba | sed -n 's/^Available versions: \([^,]*\).*/\1/p')
  if [ "$(printf '%s\n' "$bound" "$newest" | sort -V | head -n 1)" != "$bound" ]; then
    say "no Mitsuba from $bound on yet: the newest is $newest"
    return 0
  fi
  copy=$(mktemp -d)
  git clone --quiet . "$copy"
  say "the tests with Mitsuba $newest, in $copy"
  (cd "$copy" && ./run.sh setup && .venv/bin/python -m pip install --quiet "mitsuba==$newest" && ./run.sh test "$@")
}

bench() {
  OPENBLAS_NUM_THREADS=1 .venv/bin/python -m benchmarks "$@"
}

case "${1:-}" in
  setup) setup ;;
  demo) setup; demo ;;
  test) shift; setup; test_all "$@" ;;
  bench) shift; setup; bench "$@" ;;
  next) shift; setup; next_mitsuba "$@" ;;
  *) die "usage: ./run.sh demo | test [pytest arguments] | bench TIER | next [pytest arguments] | setup" ;;
esac
