"""The commands that write models in another form: `edit`, `compress`, `export` and `import`."""
