"""Simulation: a SCENE with options enters, a FrameSource with exact ground truth leaves; models of links and radios."""
