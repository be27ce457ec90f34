"""One file per subcommand, and the console that all of them print on."""
