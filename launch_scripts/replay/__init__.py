"""Recorded processes of a run, fed to the services of this build."""
