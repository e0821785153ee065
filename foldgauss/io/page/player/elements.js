// Access to the page's elements by id.
export const element = (name) => document.getElementById(name);
