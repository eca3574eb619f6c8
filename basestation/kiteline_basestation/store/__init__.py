"""The map on disk: a station's values and state enter, and a later station continues from what leaves."""
