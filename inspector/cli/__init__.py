"""The commands as they are typed: options in, exit status out; each calls what does the work."""
