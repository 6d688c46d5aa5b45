"""Playing a policy: evaluations, saved policies, films, exports."""
