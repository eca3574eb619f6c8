"""Vehicles: modelled cameras, flight controllers, services and ArduCopter in the loop enter, bars leave."""
