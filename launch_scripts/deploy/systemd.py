"""A machine of a plan as a systemd service, with the scripts that install it or run it without systemd.

One unit a machine runs `swarm up` with that machine's processes: the launcher starts a crashed process again within
a fraction of a second from a warm fork server, builds the terrain once for all, and ends roles in order. systemd
starts the launcher, limits all of it, and shuts the rest of the system off from it.
"""

from __future__ import annotations

import math
import shlex

from launch_scripts.deploy.kits import FORGET
from launch_scripts.deploy.plan import Plan, PlannedHost

UNIT = "swarm.service"
HEALTH_PORT = 9464
"""Where a machine's launcher answers probes and Prometheus, on loopback."""
_HOME, _PROGRAM = "/etc/swarm", "/opt/swarm/bin/swarm"

_UNIT = """\
[Unit]
Description=Swarm {run_id}: {roles} on {host}
Documentation=man:systemd.service(5)
Wants=network-online.target
After=network-online.target time-sync.target
# A machine whose neighbours are down tries for as long as it takes.
StartLimitIntervalSec=0

[Service]
Type=notify
ExecStart={command}
User=swarm
Group=swarm
WorkingDirectory={home}
Restart=on-failure
RestartSec=1
# It is up once its processes are started, and may wait for other machines before that.
TimeoutStartSec=infinity
WatchdogSec=30
# The launcher ends its processes role by role and writes its report; what is left after that is killed.
KillMode=mixed
TimeoutStopSec=180
# A process that is killed for want of memory is started again by the launcher.
OOMPolicy=continue

StateDirectory=swarm
CacheDirectory=swarm
StateDirectoryMode=0750
CacheDirectoryMode=0750
Environment=HOME=/var/lib/swarm XDG_STATE_HOME=/var/lib/swarm XDG_CACHE_HOME=/var/cache/swarm
Environment=NUMBA_CACHE_DIR=/var/cache/swarm/numba MPLCONFIGDIR=/var/cache/swarm/matplotlib
Environment=PYTHONUNBUFFERED=1

CPUQuota={cpu_percent}%
TasksMax=4096
LimitNOFILE=65536
LimitCORE=0
# The machine stays within reach of whoever looks after it.
MemoryMax=90%
UMask=0077

# Planners compile their kernels, so MemoryDenyWriteExecute= cannot be set.
NoNewPrivileges=yes
CapabilityBoundingSet=
AmbientCapabilities=
ProtectSystem=strict
ProtectHome=yes
PrivateTmp=yes
PrivateDevices=yes
PrivateMounts=yes
PrivateUsers=yes
ProtectClock=yes
ProtectControlGroups=yes
ProtectHostname=yes
ProtectKernelLogs=yes
ProtectKernelModules=yes
ProtectKernelTunables=yes
ProtectProc=invisible
ProcSubset=pid
RemoveIPC=yes
# Zenoh asks the kernel for the addresses of this machine, over AF_NETLINK.
RestrictAddressFamilies=AF_INET AF_INET6 AF_UNIX AF_NETLINK
RestrictNamespaces=yes
RestrictRealtime=yes
RestrictSUIDSGID=yes
LockPersonality=yes
KeyringMode=private
SystemCallArchitectures=native
SystemCallFilter=@system-service
SystemCallFilter=~@privileged
SystemCallErrorNumber=EPERM

[Install]
WantedBy=multi-user.target
"""

_INSTALL = """\
#!/bin/sh
# Installs this machine's part of the swarm and starts it: run as root. Run it again to take over a new plan.
# DESTDIR=FOLDER puts the files below FOLDER, and starts nothing.
set -eu
cd "$(dirname "$0")"
root=${{DESTDIR:-}}
fail() {{ echo "install: $*" >&2; exit 1; }}
{forget}
[ -n "$root" ] || [ "$(id -u)" = 0 ] || fail "expected root, found $(id -un); use sudo"

if [ -z "$root" ]; then
    [ -d /run/systemd/system ] || fail "there is no systemd here; ./run runs the swarm in the foreground"
    if ! getent passwd swarm >/dev/null; then
        useradd --system --user-group --home-dir /var/lib/swarm --no-create-home --shell /usr/sbin/nologin swarm
    fi
    if [ -f "$(echo wheels/*.whl)" ]; then
        [ -x /opt/swarm/bin/python ] || python3 -m venv /opt/swarm
        pip="/opt/swarm/bin/python -m pip install --quiet --disable-pip-version-check"
        $pip "$(echo wheels/*.whl)[all]"
        $pip --force-reinstall --no-deps "$(echo wheels/*.whl)" # it may have the version of the one before
    elif [ ! -x {program} ]; then
        found=$(command -v swarm) || fail "there is no program swarm: plan with --wheel, or make a venv /opt/swarm"
        case $found in
            /home/* | /root/*) fail "$found is in a home folder, which the service does not see; move it" ;;
        esac
        mkdir -p /opt/swarm/bin
        ln -sf "$found" {program}
    fi
    runuser -u swarm -- {program} --version >/dev/null 2>&1 || fail "the user swarm cannot run {program}"
    systemctl stop {unit} 2>/dev/null || true
fi

home="$root{home}"
mkdir -p "$home"
# What an earlier plan left goes; names that were revoked here stay so.
rm -rf "$home/ground" "$home/plugins" "$home"/certs/*.pem "$home"/certs/*.key
if [ -f "$home/certs/revoked" ]; then
    {{ cat "$home/certs/revoked"; [ ! -f certs/revoked ] || cat certs/revoked; }} | sort -u > "$home/revoked.new"
fi
cp -R scenario.toml plan.json certs "$home/"
[ ! -f "$home/revoked.new" ] || mv "$home/revoked.new" "$home/certs/revoked"
for folder in ground plugins; do [ ! -d "$folder" ] || cp -R "$folder" "$home/"; done
chmod -R u=rwX,g=rX,o= "$home"
mkdir -p "$root/etc/systemd/system"
cp {unit} "$root/etc/systemd/system/"
chmod 644 "$root/etc/systemd/system/{unit}"
[ -z "$root" ] || exit 0

chown -R root:swarm "$home"
systemctl daemon-reload
systemctl enable --quiet {unit}
# It may have to wait for a keeper on a machine that is installed after this one.
systemctl restart --no-block {unit}
echo "{host}: {unit} starts; journalctl -u {unit} shows what it says"
"""

_RUN = """\
#!/bin/sh
# Runs this machine's part of the swarm in the foreground, without systemd; Ctrl-C ends it. It writes into runs/.
set -eu
cd "$(dirname "$0")"
exec "${{SWARM:-swarm}}" {arguments} --runs "${{RUNS:-runs}}" "$@"
"""


def up_arguments(plan: Plan, host: PlannedHost, scenario: str) -> list[str]:
    """The words after `swarm` that start a machine's processes, without --runs."""
    only = [word for process in host.processes for word in ("--only", process.selector)]
    signals = ("--metrics-port", str(HEALTH_PORT))
    return ["up", scenario, "--run-id", plan.run_id, "--plain", *signals, *only]


def unit_text(plan: Plan, host: PlannedHost) -> str:
    """The unit of a machine."""
    roles = sorted({process.role for process in host.processes}, key=[p.role for p in host.processes].index)
    words = [_PROGRAM, *up_arguments(plan, host, f"{_HOME}/scenario.toml"), "--runs", "/var/lib/swarm/runs"]
    return _UNIT.format(
        run_id=plan.run_id,
        roles=", ".join(roles),
        host=host.name,
        command=" ".join(words),
        home=_HOME,
        cpu_percent=math.ceil(100 * host.cores),
    )


def systemd_files(plan: Plan, host: PlannedHost) -> dict[str, str]:
    """Name -> text: the unit, the script that installs it, and the one that runs without it. Scripts are those
    without an ending."""
    return {
        UNIT: unit_text(plan, host),
        "install": _INSTALL.format(forget=FORGET, home=_HOME, program=_PROGRAM, unit=UNIT, host=host.name),
        "run": _RUN.format(arguments=shlex.join(up_arguments(plan, host, "scenario.toml"))),
    }
