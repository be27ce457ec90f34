"""Decision levels: how sure a thing has to be before it is named, the same in all commands."""

CLEAR = 15.0
"""Least gain in the log marginal likelihood at which something is named: a motor that turns two
joints, or a fault. Right logs gain less; a motor that turns two joints gains many times as much
[nats]."""
SURE = 3.0
"""Standard errors from which a number is significant where many are compared."""
INTERVAL = 2.0
"""Standard errors of a printed ±: the interval that holds a number with 95 %."""
FALSE_ALARMS = 0.01
"""Share of pairs of logs of an unchanged arm in which a change is named, all numbers together, and
of bare arms on which a mass is."""
BARE = 0.25
"""Share of all cases of a chi-square from whose value on a last link carries something that its
model lacks. Last links of models are less far off than the prior of links allows for: of simulated
arms as they are that carry nothing, less than one in a hundred gets there."""
STOPPING = 4.0
"""Standard errors of an arm's weight from which a run is stopped: each joint is compared thousands
of times in a run, so that three are too few."""
ALARMING = 4.5
"""Standard errors from which a difference from the model fails a command, those of what links as
wrong as usual look like included: every run of a sound arm is compared in thirty numbers."""
TELLING = 0.02
"""Least share of all torque that such a difference has to make: a wrist that carries next to
nothing shows a zero of 9 ± 2 or 13 ± 3 degrees, which is its friction."""
UNEXPLAINED = 0.05
"""Share of all torque that neither model nor noise explains, above which a result is not
trustworthy: logs of right models have less."""
LIKE_LOG = 0.5
"""Share of the model's error on other motions above which that of the written file limits its use
to motions like the log's: there it is not even twice as good."""
