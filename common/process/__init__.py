"""Process plumbing: command lines, signals and stops, child processes, files, threads, memory."""
