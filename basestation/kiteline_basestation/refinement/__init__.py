"""New keyframes enter; landmarks are matched, triangulated and culled, and bundles refine poses and positions."""
