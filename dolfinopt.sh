#!/bin/bash
# Sets dolfinopt up on first use (Debian 12 or 13) and runs it; `usage` says how.
set -u

usage() {
  cat <<'TEXT'
usage: ./dolfinopt.sh [-n RANKS] COMMAND ...               run a command, with -n under mpirun
       ./dolfinopt.sh [-n RANKS] python FILE ...           run a script with the same interpreter
       ./dolfinopt.sh [-n RANKS] test [PYTEST ARGUMENTS]   ruff, mypy, pytest on one rank and on RANKS (2)
       ./dolfinopt.sh test --all [PYTEST ARGUMENTS]        the same with the slow tests
       ./dolfinopt.sh docs                                 build the documents into site/, strictly
       ./dolfinopt.sh --help                               list the commands

The first call sets up what is missing: on Debian 12 or 13 DOLFINx and its libraries with apt
(as root or with sudo), and Python packages in .venv. Where DOLFINx exists already (conda, Docker),
`pip install -e .` and the command `dolfinopt` do the same.
TEXT
}

here=$(cd "$(dirname "$(readlink -f "${BASH_SOURCE[0]}")")" && pwd) || exit 1
venv=$here/.venv
python=$venv/bin/python
log=$venv/setup.log

say() { echo "dolfinopt: $*" >&2; }

# --- environment: what the user has set already stays ---------------------------------------------

# One thread a rank: the ranks are the parallelism. 60 iterations with 400 x 24 cells take 11.3 and
# 11.6 s with one thread, 11.8 and 10.9 s with two; a factorisation of 200 x 12 and its solves 5.9
# and 8.2 ms.
export OMP_NUM_THREADS="${OMP_NUM_THREADS-1}"
# Packages in ~/.local must not take the place of the system's NumPy that DOLFINx was built for.
export PYTHONNOUSERSITE="${PYTHONNOUSERSITE-1}"
# Pictures without a display.
export VTK_DEFAULT_OPENGL_WINDOW="${VTK_DEFAULT_OPENGL_WINDOW-vtkEGLRenderWindow}"
export PYVISTA_OFF_SCREEN="${PYVISTA_OFF_SCREEN-true}"
# Containers run as root.
export OMPI_ALLOW_RUN_AS_ROOT="${OMPI_ALLOW_RUN_AS_ROOT-1}"
export OMPI_ALLOW_RUN_AS_ROOT_CONFIRM="${OMPI_ALLOW_RUN_AS_ROOT_CONFIRM-1}"
# More ranks than cores, and ranks of two runs not on the same cores: for Open MPI 4, then 5.
export OMPI_MCA_rmaps_base_oversubscribe="${OMPI_MCA_rmaps_base_oversubscribe-1}"
export PRTE_MCA_rmaps_default_mapping_policy="${PRTE_MCA_rmaps_default_mapping_policy-:oversubscribe}"
export OMPI_MCA_hwloc_base_binding_policy="${OMPI_MCA_hwloc_base_binding_policy-none}"
export PRTE_MCA_hwloc_default_binding_policy="${PRTE_MCA_hwloc_default_binding_policy-none}"
# Shared memory by name ("vader" to both versions): looking for networks, or merely excluding TCP,
# costs every start up to a second. For several hosts set OMPI_MCA_btl and OMPI_MCA_pml.
export OMPI_MCA_btl="${OMPI_MCA_btl-self,vader}"
export OMPI_MCA_pml="${OMPI_MCA_pml-ob1}"

# --- set-up ---------------------------------------------------------------------------------------

# What a finished set-up belongs to: these files, at this place, on this release of the system.
fingerprint() { cksum "$here/dolfinopt.sh" "$here/pyproject.toml" /etc/debian_version 2>/dev/null; }

# is_ready STAMP: the stamp is written last, an interrupted set-up has none.
is_ready() { [ -f "$venv/$1" ] && [ "$(<"$venv/$1")" = "$(fingerprint)" ]; }

# step WHAT COMMAND ...: one line for the user, the rest into the log.
step() {
  say "$1"
  shift
  echo "+ $*" >>"$log"
  "$@" >>"$log" 2>&1 </dev/null && return
  say "failed; the end of $log:"
  tail -n 15 "$log" >&2
  exit 1
}

missing_packages() {
  # libopenblas0-pthread: else the reference BLAS is linked and factorisations take three times longer.
  local wanted="python3-dolfinx python3-petsc4py python3-slepc4py python3-mpi4py python3-scipy
    python3-gmsh python3-venv libegl1 libgl1-mesa-dri libxrender1 libopenblas0-pthread"
  local installed package
  installed=$(dpkg-query -W -f '${db:Status-Abbrev}${Package}\n' 2>/dev/null)
  for package in $wanted; do
    grep -qx "[hi]i $package" <<<"$installed" || echo "$package"
  done
}

# Tests read the report in a browser (96 MB, a quarter of a minute), and are skipped without one.
install_browser() {
  [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null || return 0
  dpkg-query -W chromium-headless-shell >/dev/null 2>&1 && return 0
  DEBIAN_FRONTEND=noninteractive timeout 180 apt-get -q -y -o DPkg::Lock::Timeout=60 install \
    --no-install-recommends chromium-headless-shell >/dev/null 2>&1 ||
    say "no browser (chromium-headless-shell): tests that need one are skipped"
}

install_packages() {
  local packages sudo=()
  mapfile -t packages < <(missing_packages)
  [ ${#packages[@]} -gt 0 ] || return
  [ "$(id -u)" = 0 ] || sudo=(sudo)
  if ! command -v apt-get >/dev/null; then
    say "no apt here: install FEniCSx with conda (fenics-dolfinx slepc4py python-gmsh) or use the" \
      "Docker image dolfinx/dolfinx, then 'pip install -e .' and the command 'dolfinopt'"
    exit 1
  elif [ ${#sudo[@]} -gt 0 ] && ! command -v sudo >/dev/null; then
    say "run this once as root: apt-get install --no-install-recommends ${packages[*]}"
    exit 1
  fi
  local apt=("${sudo[@]}" env DEBIAN_FRONTEND=noninteractive apt-get -q -y
    -o Acquire::Retries=3 -o DPkg::Lock::Timeout=600)
  step "fetching the package lists (apt)" "${apt[@]}" update
  step "finishing interrupted installations (dpkg)" "${sudo[@]}" dpkg --configure -a
  step "installing DOLFINx and its libraries (apt, about two minutes)" \
    "${apt[@]}" install --no-install-recommends "${packages[@]}"
}

# set_up STAMP PROJECT: PROJECT is what pip installs: with what `dolfinopt import` needs of robots,
# or with that and what the documents or tests need.
set_up() {
  local stamp=$1 project=$2 version
  is_ready "$stamp" && return # another call did it while this one waited for the lock
  mkdir -p "$venv" || exit 1
  install_packages
  [ "$stamp" != ready-dev ] || install_browser

  # A finished environment is brought up to date in place, since others may be running in it; one
  # that was never finished or belongs to another Python is made anew.
  version=$(/usr/bin/python3 -c 'import sys; print("%d.%d" % sys.version_info[:2])') || exit 1
  if [ -f "$venv/ready" ] && [ -d "$venv/lib/python$version" ]; then
    # Runs that begin meanwhile go on with a base that is up to date: tests only add to it.
    is_ready ready || rm "$venv/ready"
    [ ! -f "$venv/ready-dev" ] || project="${here}[dev]"
  else
    find "$venv" -mindepth 1 -maxdepth 1 ! -name setup.log -exec rm -rf {} +
    step "making .venv" /usr/bin/python3 -m venv --system-site-packages "$venv"
  fi

  # The system's DOLFINx works with the system's NumPy only. Beside DOLFINx 0.5, VTK 9.4 crashes,
  # 9.6 aborts at scalar bars, and 9.3 needs an X server.
  /usr/bin/python3 - >"$venv/constraints.txt" <<'PYTHON' || exit 1
from importlib.metadata import version
print("numpy==" + version("numpy"))
if version("fenics-dolfinx").startswith("0.5."):
    print("vtk==9.5.2")
PYTHON
  step "installing Python packages (pip)" "$python" -m pip install --disable-pip-version-check \
    --no-warn-script-location -c "$venv/constraints.txt" -e "$project"
  step "checking the set-up" "$python" -c "import dolfinx.fem, gmsh, slepc4py, pyvista"

  fingerprint >"$venv/ready"
  [ "$stamp" != ready-docs ] || cp "$venv/ready" "$venv/ready-docs"
  [ "$project" != "${here}[dev]" ] || cp "$venv/ready" "$venv/ready-dev"
}

# ensure STAMP PROJECT: sets up unless that was done; one call at a time.
ensure() {
  is_ready "$1" && return
  (
    flock -n 9 || { say "waiting for another set-up"; flock 9; }
    set_up "$@"
  ) 9<"$here" || exit
}

# --- running --------------------------------------------------------------------------------------

# Containers without an /etc/hosts wait 5 s in MPI_Init for a name server to know them.
answer_soon() { export RES_OPTIONS="${RES_OPTIONS-timeout:1 attempts:1}"; }

# Drop what mpirun adds to a status other than 0, since the ranks have said what is wrong; what it
# says of killed ranks or its own troubles stays.
drop_chatter() {
  trap '' INT TERM # it ends after mpirun, whose last words it passes on
  sed -u -e 's/\x00//g' -e '/PMIX ERROR: PMIX_ERR_UNREACH in file .*pmix_server.c/d' \
    -e '/ORTE_ERROR_LOG: .* in file .*show_help.c/d' |
    sed -u '/^-\{70,\}$/{
      N
      /\n\(prterun has exited due\|.*run detected that one or more\|MPI_ABORT was\|Primary job\)/!b
      :rest
      N
      /\n-\{70,\}$/!b rest
      d
    }'
}

# --- tests ----------------------------------------------------------------------------------------

# check NAME COMMAND ...: keeps the last line of the output and the verdict for the summary.
check() {
  local name=$1 begin=$SECONDS
  shift
  echo "== $name"
  "$@" 2>&1 | drop_chatter | tee "$output"
  judge "$name" "${PIPESTATUS[0]}" $((SECONDS - begin)) "$output"
}

# judge NAME STATUS TIME FILE: a line of the summary.
judge() {
  local verdict=ok
  if [ "$2" != 0 ]; then
    verdict=FAILED
    failed+=("$1")
  fi
  summary+=$(printf '%-6s  %-20s %4d s  %s' "$verdict" "$1" "$3" \
    "$(grep -v '^ *$' "$4" | tail -n 1)")$'\n'
}

# beside FILE COMMAND ...: runs it, its output into FILE, and ends with its status.
beside() {
  local file=$1 begin=$SECONDS status
  shift
  trap 'kill "$!" 2>/dev/null' TERM
  "$@" >"$file" 2>&1 &
  wait "$!"
  status=$?
  echo $((SECONDS - begin)) >"$file.time"
  return "$status"
}

# told NAME PROCESS FILE: waits for what runs beside; prints its output and judges it.
told() {
  local status
  wait "$2"
  status=$?
  echo "== $1"
  drop_chatter <"$3" | tee "$output"
  judge "$1" "$status" "$(<"$3.time")" "$output"
}

run_tests() {
  local output folder types several summary="" failed=()
  folder=$(mktemp -d) || exit 1
  output=$folder/output
  trap "rm -rf '$folder'" EXIT
  cd "$here" || exit 1
  answer_soon
  export NO_COLOR=1 # mpirun gives the ranks a terminal even when there is none
  # Tests start a hundred processes, which share compiled modules, in folders that git ignores.
  unset PYTHONDONTWRITEBYTECODE
  check "ruff check" "$python" -m ruff check .
  check "ruff format" "$python" -m ruff format --check .
  check "imports" "$venv/bin/lint-imports" --no-cache
  # Types, and tests on several ranks, which are never busy all the time, beside the tests on one
  # rank; they are told of afterwards. Ranks that wait for others let the processors to other tests.
  # A -m among the arguments wins. What takes long need not take it twice.
  local asked=(-m "not slow")
  [ -z "$all" ] || asked=()
  beside "$folder/types" "$python" -m mypy &
  types=$!
  OMPI_MCA_mpi_yield_when_idle=1 beside "$folder/several" \
    /usr/bin/mpirun -n "$ranks" "$python" -m pytest -m "not slow" "$@" &
  several=$!
  trap "kill $types $several 2>/dev/null; rm -rf '$folder'" EXIT
  # One rank a test, in as many processes; the tests of a file share what they build.
  check "pytest" "$python" -m pytest -n "$ranks" --dist loadfile "${asked[@]}" "$@"
  told "mypy" "$types" "$folder/types"
  told "pytest, $ranks ranks" "$several" "$folder/several"
  printf '== summary\n%s' "$summary"
  if [ ${#failed[@]} -gt 0 ]; then
    printf 'FAILED:%s\n' "$(printf ' %s;' "${failed[@]}")"
    exit 1
  fi
  echo "all checks passed"
}

# --- command line ---------------------------------------------------------------------------------

ranks=""
if [ "${1-}" = -n ]; then
  ranks=${2-}
  if ! [[ $ranks =~ ^[1-9][0-9]*$ ]]; then
    say "-n needs a number of ranks, 1 or more, not '$ranks'"
    exit 2
  fi
  shift 2
fi

case ${1-} in
  "" | -h)
    usage
    [ -z "$ranks" ] || exit 2
    ;;
  test)
    shift
    ranks=${ranks:-2} all=""
    if [ "${1-}" = --all ]; then
      all=1
      shift
    fi
    ensure ready-dev "${here}[dev]"
    run_tests "$@"
    ;;
  docs)
    if [ $# -gt 1 ] || [ -n "$ranks" ]; then
      say "docs takes no arguments: ./dolfinopt.sh docs writes site/"
      exit 2
    fi
    is_ready ready-dev || ensure ready-docs "${here}[robots,docs]"
    # NO_MKDOCS_2_WARNING: of the theme, about a version that is not used.
    NO_MKDOCS_2_WARNING=1 "$python" -m mkdocs build --strict --clean --quiet -f "$here/docs/mkdocs.yml" ||
      exit
    say "documents in $here/site/index.html"
    ;;
  python)
    shift
    if [ $# -eq 0 ]; then
      say "python needs a script: ./dolfinopt.sh python FILE ..."
      exit 2
    fi
    ensure ready "${here}[robots]"
    answer_soon
    [ -n "$ranks" ] || exec "$python" "$@"
    exec 2> >(drop_chatter >&2)
    exec /usr/bin/mpirun -n "$ranks" "$python" "$@"
    ;;
  *)
    ensure ready "${here}[robots]"
    answer_soon
    # -P: a file in the current folder must not take the place of a module.
    [ -n "$ranks" ] || exec "$python" -P -m dolfinopt "$@"
    exec 2> >(drop_chatter >&2)
    exec /usr/bin/mpirun -n "$ranks" "$python" -P -m dolfinopt "$@"
    ;;
esac
