"""The effects that a scene may list. They never import each other; they meet only through named
fields."""
