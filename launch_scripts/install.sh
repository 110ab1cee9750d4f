# Sourced by demo, test and .ci/run: makes .venv what uv.lock says, or stops with one sentence.
# Nothing outside this folder changes, caches aside. An up-to-date .venv is left alone, so that needs no network.

uv_version=0.13.8 # used where no uv is installed; the same lock, so the same versions
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

sync_with() { (cd "$root" && env -u VIRTUAL_ENV UV_PROJECT_ENVIRONMENT="$venv" UV_PYTHON_DOWNLOADS=never \
    "$@" sync --frozen --extra all --inexact --quiet --python "$python"); }

install() {
    if [[ -x $venv/bin/python && -f $stamp && $(<"$stamp") == "$(wanted)" ]] && suits "$venv/bin/python"; then
        return
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
            if ! "$python" -m pip install --quiet --disable-pip-version-check "uv==$uv_version"; then
                say "Cannot install uv $uv_version with pip: the first start needs the network."
                exit 1
            fi
        fi
        if ! sync_with "$python" -m uv; then
            say "Cannot install what uv.lock lists: the first start needs the network."
            exit 1
        fi
    fi
    wanted >"$stamp"
    say "Installed. The first start loads and compiles what all later ones find ready: half a minute, or more from a slow disk."
}
