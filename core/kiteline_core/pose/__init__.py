"""Matches between points and pixels enter; camera poses leave."""
