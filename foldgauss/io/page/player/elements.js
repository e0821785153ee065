// The page's elements by their names.
export const element = (name) => document.getElementById(name);
