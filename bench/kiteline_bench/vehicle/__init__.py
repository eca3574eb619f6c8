"""kiteline on a vehicle: live cameras, flight controllers modelled and in software in the loop, services."""
