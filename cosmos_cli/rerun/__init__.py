"""A recorded run flown again in lockstep, with its devices played back, and compared with what is on record."""
