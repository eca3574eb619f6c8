"""What is sent to agents: changed values of the map leave as records, cached keyframes go to agents that need them."""
