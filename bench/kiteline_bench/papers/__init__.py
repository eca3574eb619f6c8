"""The experiments of the papers that kiteline builds on, beside its own figures."""
