"""Loop closures and map merges: keyframes enter; moved maps, fused landmarks and jobs for the worker leave."""
