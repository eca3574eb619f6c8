"""Residual codes: codes of records in fewer bytes, predicted from values that both sides hold.

In: a code and the values held. Out: a residual code; and the reverse.
"""
