"""Recordings and cameras by name: a SOURCE such as `euroc:DIR` enters, a FrameSource with rig and samples leaves."""
