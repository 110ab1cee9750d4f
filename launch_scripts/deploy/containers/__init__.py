"""Processes of a plan in containers: a compose file for each machine, or manifests for Kubernetes."""
