"""Every way to a consensus: rollout, refinement, exact search; one loop drives them all."""
