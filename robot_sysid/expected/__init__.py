"""How far off a model will be on motions that nobody recorded: one formula for all who ask.

What is known of an arm (``knowledge``, after logs; ``unrecorded_arm``, before any) and the sums of
motions that are made up (``motions``) give the error to expect of a model (``errors``). A plan, a
written file and the next motion ask for it.
"""
