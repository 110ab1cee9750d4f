"""Results per target, group and vehicle as CSV, and as rows of any table. Pure."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from typing import Any

TABLES = {"by_target": ("targets.csv", "target"), "by_group": ("groups.csv", "group"),
          "by_vehicle": ("vehicles.csv", "vehicle")}  # fmt: skip
"""Section of the report -> its file, and what its first column is called."""
_GAP = ("mean", "p95", "max", "unproven")


def csv_of(section: str, report: Mapping[str, Any]) -> bytes:
    """One row per target, group or vehicle. What has no value is empty."""
    rows = [flat(id, row) for id, row in report[section].items()]
    columns = list(dict.fromkeys(name for row in rows for name in row))
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow([TABLES[section][1], *columns[1:]])
    writer.writerows([row.get(name) for name in columns] for row in rows)
    return file.getvalue().encode()


def flat(id: str, row: Mapping[str, Any]) -> dict[str, Any]:
    """A row without tables inside: `certified_gap_mean` and so on."""
    values: dict[str, Any] = {"id": id}
    for name, value in row.items():
        if name == "certified_gap":
            values |= {f"{name}_{part}": (value or {}).get(part) for part in _GAP}
        else:
            values[name] = value
    return values
