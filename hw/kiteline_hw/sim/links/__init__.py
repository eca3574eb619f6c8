"""Models of links and radios: packets and times enter, delayed, lost or forwarded packets leave."""
