// The tests share the headers that are precompiled for this file (see CMakeLists.txt); the program runs no test.
