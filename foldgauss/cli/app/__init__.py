"""The application: `application.app`, the `registry` of commands, help with examples, completion and error handling."""
