"""The report of a run: recorder, report.json, report.png."""
