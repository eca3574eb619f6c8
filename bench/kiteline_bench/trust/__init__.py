"""What may happen: hostile input, disks that are full or alter bits, and cloned cards enter, bars leave."""
