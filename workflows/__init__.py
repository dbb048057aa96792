"""What is run: configuration, plan, execution, storage, reports, sample archives and the command line."""
