// Nothing but depth: what is hidden is then not looked up.

void main() {}
