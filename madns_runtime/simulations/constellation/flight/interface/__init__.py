"""
Flight software outside the agent's process: how bytes go (a transport) and what they mean (a protocol).

    vehicle -> reports -> protocol -> packets -> transport -> program, board, emulator
    vehicle <- answers <- protocol <- bytes   <- transport <-

A protocol is pure: reports in, packets out; bytes in, answers and counted faults out. A transport never waits,
is bounded, and knows no content. `flight.process` is the vehicle's side: it sends a tick's report, takes answers
and carries them out by rules that are the same for every protocol.
"""
