"""Models of links, radios and flight controllers: packets and times enter, delayed, lost or forwarded packets leave."""
