"""The experiments of the papers that kiteline builds on: flights like theirs enter; bars leave."""
