"""The replay role: the table of transitions, its limiter and the service around them. Never imports torch."""
