"""A simulated world, a modelled link, a modelled flight controller."""
