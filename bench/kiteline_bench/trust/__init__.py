"""What may happen: hostile input at every door, disks that are full or alter bits, cards that are lost or cloned."""
