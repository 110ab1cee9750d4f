"""What a swarm of any size needs: counted in simulations and measured live, fitted, checked and extrapolated."""
