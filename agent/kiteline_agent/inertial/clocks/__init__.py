"""When frames and samples were taken: stamps that scatter enter, times at a constant rate leave."""
