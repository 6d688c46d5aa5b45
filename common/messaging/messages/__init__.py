"""The messages of a run, a module for each conversation.

control   join / join-reply: a role asks the learner for the run's data; leave / farewell: a role stops;
          snapshot, written: begins the replay service's part of a checkpoint, and asks whether it is on disk;
          limit / limits: reads and changes the limiter's settings; stop: the learner ends the run
insert    insert: a segment for the table
sample    sample / batch: the learner draws a batch; the answer also carries the episodes that ended
answers   ack, retry, error: a receipt; a request to try again later, with the reason; a rejection or failure
weights   weights, role: the learner's broadcasts; current: asks for the latest of them
evaluate  evaluated, video: an evaluator's results and pictures, for the run directory
status    status: the state of a role, for displays; stats: the replay service's counters

Each message is a struct whose field types give the allowed values. `encode` builds its bytes; `decode` reads them and
raises BadMessage, which names the invalid field. body.py holds the common parts.
"""
