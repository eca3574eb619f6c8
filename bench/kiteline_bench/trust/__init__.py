"""What strangers, faulty agents and damaged files may do: hostile input for every door."""
