"""What a swarm on several machines needs: certificates, and a configuration for zenohd."""
