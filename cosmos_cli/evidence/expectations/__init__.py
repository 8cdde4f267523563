"""
Judgement of a run's expectations over all of its records.

Each table that an expectation is about is read once, source by source, some ten thousand records at a time, however
many expectations look at it. Of each expectation and agent one accumulator is kept: a statistic needs a few numbers,
p99 the largest hundredth of one agent's values, which makes it exact, and an event the times at which it occurred. An
expectation holds if it holds for each of its agents; the result tells the worst of them.

What has no value is broken: a field that never came, and NaN, which is recorded as null. What a run of this time mode
does not record is not judged, and listed.
"""
