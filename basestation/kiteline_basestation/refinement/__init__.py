"""New keyframes enter; matched, triangulated and culled landmarks and bundle-adjusted poses leave."""
