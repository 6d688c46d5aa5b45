"""Communication between processes: the wire format, the messages of each conversation, and the Zenoh transport."""
