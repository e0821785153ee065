"""The commands that write models in another form: `edit`, `segment`, `compress`, `export` and `import`."""
