"""
Replies of the helper on a machine, held to their shapes before anybody works with them.

`verbs` is the table of what each verb may reply, made of `shapes` and shared `parts`; `reader` reads the frames,
each within a deadline as a whole and a bound on its size.
"""
