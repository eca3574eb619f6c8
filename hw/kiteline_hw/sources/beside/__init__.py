"""Files beside a recording: a source and its folder enter, the source with what they hold leaves."""
