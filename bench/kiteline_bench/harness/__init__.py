"""Scenarios and recordings enter; flights of the product, their results and the bars on them leave."""
