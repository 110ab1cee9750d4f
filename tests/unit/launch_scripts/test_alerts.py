"""Each alert queries an exported metric, names a remedy, and fires on its condition."""

import re
import shutil
import subprocess
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml
from support.exported_metrics import exported

from launch_scripts import web
from swarm.wire.messages.vehicles import VehicleState

_ALERTS = Path(web.__file__).with_name("alerts.yml")
_PAGE = Path(__file__).parents[3] / "docs" / "reference" / "metrics.md"


def rules() -> list[dict[str, Any]]:
    [group] = yaml.safe_load(_ALERTS.read_text(encoding="utf-8"))["groups"]
    assert set(group) == {"name", "rules"}
    found: list[dict[str, Any]] = group["rules"]
    return found


@pytest.mark.parametrize("rule", rules(), ids=lambda rule: rule["alert"])
def test_a_rule_asks_for_what_is_exported_and_says_what_to_do(rule: dict[str, Any]) -> None:
    known = exported()
    asked = re.findall(r"swarm_[a-z0-9_]+", rule["expr"])
    assert asked
    assert set(asked) <= set(known)
    labels = set.intersection(*(known[name] for name in asked)) if len(asked) else set()
    said = rule["annotations"]
    assert set(said) == {"summary", "runbook"}
    assert set(re.findall(r"\$labels\.(\w+)", said["summary"])) <= labels
    assert set(re.findall(r"\b(\w+)=\"", rule["expr"])) <= labels
    for state in re.findall(r"state=\"(\w+)\"", rule["expr"]):
        assert state.upper() in VehicleState.__members__
    assert rule["labels"] in ({"severity": "critical"}, {"severity": "warning"})
    assert re.fullmatch(r"\d+[sm]", rule.get("for", "0s"))
    assert set(rule) <= {"alert", "expr", "for", "labels", "annotations"}
    assert said["runbook"] == f"docs/reference/metrics.md#{rule['alert'].lower()}"


def test_every_alert_has_a_heading_with_its_severity_and_every_heading_an_alert() -> None:
    told = re.findall(r"^### (\w+)\n\n\*(Critical|Warning)\.\*", _PAGE.read_text(), re.MULTILINE)
    assert told == [(rule["alert"], rule["labels"]["severity"].capitalize()) for rule in rules()]
    assert len(re.findall(r"^### ", _PAGE.read_text(), re.MULTILINE)) == len(told)


HISTORIES = tomllib.loads(Path(__file__).with_name("alert_histories.toml").read_text(encoding="utf-8"))
FIRES: dict[str, dict[str, str]] = HISTORIES["fires"]
"""Alert -> the series by which it fires."""


def test_there_is_a_history_for_every_alert() -> None:
    assert list(FIRES) == [rule["alert"] for rule in rules()]


@pytest.mark.skipif(shutil.which("promtool") is None, reason="promtool, of Prometheus, is not installed")
def test_promtool_says_that_each_alert_fires_on_its_history_and_none_while_all_is_well(tmp_path: Path) -> None:
    (tmp_path / "alerts.yml").write_text(_ALERTS.read_text(encoding="utf-8"))

    def history(series: dict[str, str], expected: dict[str, bool]) -> dict[str, Any]:
        return {
            "interval": "15s",
            "input_series": [{"series": name, "values": values} for name, values in series.items()],
            "promql_expr_test": [
                {
                    "expr": f'count(ALERTS{{alertname="{alert}", alertstate="firing"}}) > 0 or vector(0)',
                    "eval_time": "7m",
                    "exp_samples": [{"labels": "{}", "value": float(fires)}],
                }
                for alert, fires in expected.items()
            ],
        }

    tests = [history(HISTORIES["well"], dict.fromkeys(FIRES, False))]
    tests += [history(series, {alert: True}) for alert, series in FIRES.items()]
    (tmp_path / "tests.yml").write_text(yaml.safe_dump({"rule_files": ["alerts.yml"], "tests": tests}))
    for command in (["check", "rules", "alerts.yml"], ["test", "rules", "tests.yml"]):
        told = subprocess.run(["promtool", *command], cwd=tmp_path, capture_output=True, text=True, timeout=120)
        assert told.returncode == 0, told.stdout + told.stderr
