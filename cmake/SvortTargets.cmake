# Options and helpers shared by all targets.

find_program(CCACHE_PROGRAM ccache)
if(CCACHE_PROGRAM AND NOT CMAKE_CXX_COMPILER_LAUNCHER)
  set(CMAKE_CXX_COMPILER_LAUNCHER ${CCACHE_PROGRAM})
endif()

# Warnings and sanitizers of this project's own targets.
function(svort_target_options target)
  target_compile_options(${target} PRIVATE -Wall -Wextra -Wconversion -Wshadow)
  if(SVORT_WERROR)
    target_compile_options(${target} PRIVATE -Werror)
  endif()
  if(SVORT_SANITIZE)
    # GCC 12 takes an instrumented std::optional for uninitialised.
    target_compile_options(${target} PRIVATE -fsanitize=${SVORT_SANITIZE} -fno-omit-frame-pointer
                                             -Wno-maybe-uninitialized)
    target_link_options(${target} PRIVATE -fsanitize=${SVORT_SANITIZE})
  endif()
endfunction()

# svort_library(<name> MODULE <folder of src/> LINK <libraries>...)
# All .cpp files of the folder become one shared library.
function(svort_library name)
  cmake_parse_arguments(ARG "" "MODULE" "LINK" ${ARGN})
  file(GLOB sources CONFIGURE_DEPENDS ${PROJECT_SOURCE_DIR}/src/${ARG_MODULE}/*.cpp)
  add_library(${name} SHARED ${sources})
  target_include_directories(${name} PUBLIC $<BUILD_INTERFACE:${PROJECT_SOURCE_DIR}/include>
                                            $<INSTALL_INTERFACE:include>)
  target_link_libraries(${name} PUBLIC ${ARG_LINK})
  svort_target_options(${name})
endfunction()
