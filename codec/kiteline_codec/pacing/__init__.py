"""How much to send and when: profiles, sections of keyframes, byte budget, congestion window, measured throughput.

In: a keyframe's records, times, bytes sent and acknowledged. Out: sections to share, and how many bytes may leave.
"""
