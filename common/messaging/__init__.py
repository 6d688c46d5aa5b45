"""How processes talk: the wire format, the messages of each conversation, and Zenoh underneath."""
