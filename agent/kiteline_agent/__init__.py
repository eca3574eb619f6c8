"""The onboard half: tracks under a CPU budget and never waits for anybody."""
