#!/bin/sh
# Makes or updates the virtual environment: sh tools/bootstrap.sh PYTHON VENV
# On success VENV/.installed exists. VENV/.unfinished marks one that was interrupted; it is rebuilt on the next run.
#
# PyPI's PyTorch for Linux comes with several GB of CUDA libraries. For the CPU build set
#   PIP_EXTRA_INDEX_URL=https://download.pytorch.org/whl/cpu
set -eu

python=$1
venv=$2
group=dev # one environment for every target, so that no target reinstalls what another one needed
minimum_minor=11 # mujoco>=4 needs Python 3.11

fail() {
    printf '\nerror: %s\n' "$1" >&2
    shift
    [ $# -eq 0 ] || printf '  %s\n' "$@" >&2
    exit 1
}

check_python() {
    need="need >= 3.$minimum_minor"
    command -v "$python" >/dev/null 2>&1 ||
        fail "'$python' was not found, $need." \
            "Name the Python to use: make PYTHON=python3.11 demo" \
            "On Debian or Ubuntu: apt-get install python3 python3-venv"
    found=$("$python" -c 'import sys; print("%d.%d.%d" % sys.version_info[:3])') ||
        fail "'$python' does not start, $need." "Name another Python: make PYTHON=python3.11 demo"
    major=${found%%.*}
    minor=${found#*.}
    minor=${minor%%.*}
    if [ "$major" -ne 3 ] || [ "$minor" -lt "$minimum_minor" ]; then
        fail "found Python $found ('$python'), $need." \
            "Install a newer Python and name it: make PYTHON=python3.11 demo"
    fi
    "$python" -c 'import venv, ensurepip' 2>/dev/null ||
        fail "Python $found ('$python') lacks the modules venv and ensurepip." \
            "On Debian or Ubuntu: apt-get install python3-venv (or python3.$minor-venv)"
}

# uv's environments have no pip, and are as good.
if [ ! -e "$venv/.unfinished" ] && grep -qs '^uv = ' "$venv/pyvenv.cfg"; then
    "$venv/bin/python" -m pip --version >/dev/null 2>&1 || "$venv/bin/python" -m ensurepip >/dev/null 2>&1 || :
fi

fresh=no
if [ -e "$venv/.unfinished" ] || ! "$venv/bin/python" -m pip --version >/dev/null 2>&1; then
    check_python
    if [ -e "$venv" ]; then
        [ -e "$venv/.unfinished" ] || [ -e "$venv/pyvenv.cfg" ] ||
            fail "'$venv' is there but is not a virtual environment: move it away."
        echo "$venv is incomplete: building it again."
        rm -rf "$venv"
    fi
    fresh=yes
    mkdir -p "$venv"
    : >"$venv/.unfinished"
    "$python" -m venv "$venv" || fail "'$python -m venv $venv' failed, see above."
fi

install() {
    "$venv/bin/python" -m pip install --quiet --disable-pip-version-check --no-input "$@"
}

echo "Installing torchrl-morl and the group '$group' into $venv (the first time takes a few minutes) ..."
: >"$venv/.unfinished"
rm -f "$venv/.installed"
if ! install 'pip>=25.1' || ! install -c constraints.txt -e . --group "$group"; then # older ones know no groups
    # pip leaves a working environment as it was when it gives up, so only a new one is thrown away
    [ "$fresh" = yes ] || rm -f "$venv/.unfinished"
    fail "pip could not install the dependencies; its reason is above. Run the same command again after one of these:" \
        "- no network, or a proxy: set HTTPS_PROXY, or PIP_INDEX_URL for a mirror;" \
        "- offline: with a network and the same Python version, fill a folder by" \
        "    python3 -m pip wheel -w wheelhouse -c constraints.txt pip hatchling editables . --group $group   # pip >= 25.1" \
        "  and here: PIP_NO_INDEX=1 PIP_FIND_LINKS=/path/to/wheelhouse make test;" \
        "- disk full: PyPI's PyTorch for Linux brings several GB of CUDA; the CPU build is much smaller:" \
        "    PIP_EXTRA_INDEX_URL=https://download.pytorch.org/whl/cpu make test;" \
        "- no matching distribution: the versions in constraints.txt were tested with Python 3.11."
fi
rm -f "$venv/.unfinished"
: >"$venv/.installed"
