"""The messages of a run, a module for each conversation.

join      join / joined: a role asks the learner for the run; leave / farewell: a role that was told to stop
insert    insert: a segment for the table
sample    sample / batch: the learner draws; also carries the episodes that ended
answers   ack, retry, error: a receipt; not now, and why; what is wrong with a message or could not be carried out
weights   weights, role: the learner's broadcasts; current: asks for the latest of them
stats     stats: the replay service's counters
limits    limit / limits: the limiter's settings, asked for and changed
epoch     snapshot, written: the replay service's part of an epoch is to be begun; is it on disk?
status    status: what a role is doing, for displays
stop      stop: the learner ends the run

Each message is one struct whose fields say what they may hold. `encode` builds its bytes, `decode` reads it back and
raises BadMessage, naming the field. body.py is what they have in common.
"""
