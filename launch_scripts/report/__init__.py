"""What a run leaves behind: the recorder, report.json, report.png."""
