# Sourced by demo, test, bench, docs and .ci/run: makes .venv what uv.lock says, or stops with one sentence.
# Nothing outside this folder changes, caches aside. An up-to-date .venv is left alone, so that needs no network.
#
#     install          what a run needs
#     install tools    the developer's tools, too: tests, linters, the documentation, peers of benchmarks

root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
venv="$root/.venv"
stamp="$venv/.installed"

# Where it is set, every start would compile every module of every dependency again: seconds. They stay in this folder.
unset PYTHONDONTWRITEBYTECODE

say() { echo "$@" >&2; }

suits() { "$1" -c 'import sys; sys.exit(sys.version_info < (3, 11))' >/dev/null 2>&1; }

find_python() {
    local candidate
    for candidate in "$venv/bin/python" python3.13 python3.12 python3.11 python3 python; do
        if command -v "$candidate" >/dev/null 2>&1 && suits "$candidate"; then
            "$candidate" -c 'import sys; print(sys.executable)'
            return
        fi
    done
    return 1
}

wanted() { cat "$root/uv.lock" "$root/pyproject.toml" "$root/launch_scripts/install.sh" | cksum; }

# A .venv with the tools has all that a run needs.
is_current() {
    [[ -x $venv/bin/python && -f $stamp ]] && suits "$venv/bin/python" || return 1
    local found
    found=$(<"$stamp")
    [[ $found == "$(wanted) tools" || ($1 == run && $found == "$(wanted) run") ]]
}

sync_with() { (cd "$root" && env -u VIRTUAL_ENV UV_PROJECT_ENVIRONMENT="$venv" UV_PYTHON_DOWNLOADS=never SWARM_COMMIT= \
    "$@" sync --frozen --extra all "${groups[@]}" --inexact --quiet --python "$python"); }

install() {
    local what=${1:-run}
    local groups=(--no-dev)
    if is_current "$what"; then
        return
    fi
    # Tools that are there stay: whoever has run the tests once keeps them.
    if [[ $what == tools || (-f $stamp && $(<"$stamp") == *tools) ]]; then
        what=tools groups=()
    fi
    if ! python=$(find_python); then
        say "This needs Python 3.11 or newer, and none of python3.13, python3.12, python3.11 and python3 on PATH is."
        exit 1
    fi
    say "Installing into $venv (once) ..."
    if ! { command -v uv >/dev/null 2>&1 && sync_with uv; }; then
        if ! suits "$venv/bin/python" && ! "$python" -m venv --clear "$venv"; then
            say "Cannot make $venv: install uv, or Python's venv module (on Debian: apt install python3-venv)."
            exit 1
        fi
        python="$venv/bin/python"
        if ! "$python" -m uv --version >/dev/null 2>&1; then
            "$python" -m ensurepip >/dev/null 2>&1 || true
            if ! "$python" -m pip install --quiet --disable-pip-version-check --require-hashes -r "$root/launch_scripts/uv.txt"; then
                say "Cannot install uv with pip, as launch_scripts/uv.txt names it: the first start needs the network."
                exit 1
            fi
        fi
        if ! sync_with "$python" -m uv; then
            say "Cannot install what uv.lock lists: the first start needs the network."
            exit 1
        fi
    fi
    echo "$(wanted) $what" >"$stamp"
    say "Installed. The first start loads and compiles what all later ones find ready: half a minute, or more from a slow disk."
}
