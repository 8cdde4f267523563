"""
Output for a person and questions to one: console, progress, words. Data go to stdout, talk to stderr.

Everything that is printed passes `console`, which cleans foreign text; nothing here knows of runs or machines.
"""
