"""Maps and recordings."""
