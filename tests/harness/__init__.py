"""What tests of several folders share: recorded runs that nobody made, fleets that are none, programs that misbehave."""
