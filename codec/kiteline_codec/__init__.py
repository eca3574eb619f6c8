"""What the two sides say: values, their codes, packets, and the endpoints that keep both sides in agreement. Pure."""
