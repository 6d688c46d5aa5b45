"""What methods change in the learner's update."""
