"""What every role shares: types, configuration, wire format, transport, clients, networks, schedules."""
