"""The player: one HTML page that contains a model and renders it with WebGL.

`player_page.write_html` writes the page to a file and `player_page.html_page` returns its text. `player/` contains the
page's own sources, and `compact.js` decodes compact model files in the browser.
"""
