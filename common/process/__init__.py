"""What every process needs: command lines, signals and stops, child processes, files, threads, memory."""
