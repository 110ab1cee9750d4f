"""Deployment on several machines: certificates, and a configuration for zenohd."""
