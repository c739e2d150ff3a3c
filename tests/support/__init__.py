"""What several tests share: obvious twins of operators, tiny scenes, small runs."""
