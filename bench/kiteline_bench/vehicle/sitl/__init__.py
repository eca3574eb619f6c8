"""ArduCopter in software in the loop: a built binary and a scene enter; flights and bars leave."""
