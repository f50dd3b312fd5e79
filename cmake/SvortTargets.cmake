# Options and helpers shared by all targets.

find_program(CCACHE_PROGRAM ccache)
if(CCACHE_PROGRAM AND NOT CMAKE_CXX_COMPILER_LAUNCHER)
  # Without these, ccache does not keep what was compiled with precompiled headers, or not for other folders: the compiled
  # header is never the same twice, so ccache looks at the file beside it (svort_precompile_headers) instead.
  set(CMAKE_CXX_COMPILER_LAUNCHER ${CMAKE_COMMAND} -E env CCACHE_SLOPPINESS=pch_defines,time_macros
                                  CCACHE_PCH_EXTSUM=true ${CCACHE_PROGRAM})
endif()

# Warnings and sanitizers of this project's own targets.
function(svort_target_options target)
  target_compile_options(${target} PRIVATE $<$<COMPILE_LANGUAGE:CXX>:-Wall -Wextra -Wconversion -Wshadow>)
  if(SVORT_WERROR)
    target_compile_options(${target} PRIVATE $<$<COMPILE_LANGUAGE:CXX>:-Werror>)
  endif()
  if(SVORT_SANITIZE)
    # GCC 12 takes an instrumented std::optional for uninitialised.
    target_compile_options(${target} PRIVATE -fsanitize=${SVORT_SANITIZE} -fno-omit-frame-pointer
                                             -Wno-maybe-uninitialized)
    target_link_options(${target} PRIVATE -fsanitize=${SVORT_SANITIZE})
  endif()
endfunction()

# LibTorch's and Eigen's headers take most of the time of most files: they are compiled once per kind of target.
option(SVORT_PRECOMPILED_HEADERS "Compile LibTorch's and Eigen's headers once" ON)
set(svort_precompiled_headers <torch/types.h> <Eigen/Core> <Eigen/Geometry> <string> <vector>)

# svort_precompile_headers(<target> <owner> [<header>...])
# The first target of a kind names itself as the owner; all others of the kind, compiled with the same options, reuse
# what it precompiles.
function(svort_precompile_headers target owner)
  if(NOT SVORT_PRECOMPILED_HEADERS)
    return()
  endif()
  if(CMAKE_CXX_COMPILER_ID STREQUAL "GNU")
    target_compile_options(${target} PRIVATE -fpch-preprocess)  # ccache needs it
  endif()
  if(target STREQUAL owner)
    target_precompile_headers(${target} PRIVATE ${svort_precompiled_headers} ${ARGN})
    # What the compiled header depends on, for ccache.
    get_target_property(folder ${target} BINARY_DIR)
    file(GENERATE OUTPUT ${folder}/CMakeFiles/${target}.dir/cmake_pch.hxx.gch.sum CONTENT
      "${svort_precompiled_headers} ${ARGN}\n${CMAKE_CXX_COMPILER_ID} ${CMAKE_CXX_COMPILER_VERSION}\nTorch ${Torch_VERSION} \
Eigen ${EIGEN3_VERSION_STRING} GTest ${GTest_VERSION}\n${CMAKE_BUILD_TYPE} ${CMAKE_CXX_FLAGS} ${SVORT_SANITIZE}\n")
  else()
    target_precompile_headers(${target} REUSE_FROM ${owner})
  endif()
endfunction()

# svort_library(<name> MODULE <folder of src/> LINK <libraries>...)
# All .cpp files of the folder become one shared library.
function(svort_library name)
  cmake_parse_arguments(ARG "" "MODULE" "LINK" ${ARGN})
  file(GLOB sources CONFIGURE_DEPENDS ${PROJECT_SOURCE_DIR}/src/${ARG_MODULE}/*.cpp)
  add_library(${name} SHARED ${sources})
  # No macro of its own: it would keep libraries from sharing the precompiled headers.
  set_target_properties(${name} PROPERTIES DEFINE_SYMBOL "")
  target_include_directories(${name} PUBLIC $<BUILD_INTERFACE:${PROJECT_SOURCE_DIR}/include>
                                            $<INSTALL_INTERFACE:include>)
  target_link_libraries(${name} PUBLIC ${ARG_LINK})
  svort_target_options(${name})
  svort_precompile_headers(${name} svort_geometry)
endfunction()

# Adds src/<folder>/cuda to a library: kernels (.cu) and what calls them.
function(svort_cuda_sources name folder)
  if(NOT TARGET torch_cuda)
    message(FATAL_ERROR "SVORT_WITH_CUDA needs a LibTorch that was built with CUDA")
  endif()
  file(GLOB sources CONFIGURE_DEPENDS ${PROJECT_SOURCE_DIR}/src/${folder}/cuda/*.cpp
       ${PROJECT_SOURCE_DIR}/src/${folder}/cuda/*.cu)
  target_sources(${name} PRIVATE ${sources})
  target_compile_definitions(${name} PUBLIC SVORT_WITH_CUDA)
  # The last bit of a position decides whether a tap counts: as on the CPU, nothing is fused.
  set_source_files_properties(${sources} PROPERTIES COMPILE_OPTIONS "$<$<COMPILE_LANGUAGE:CUDA>:-fmad=false>")
  set_target_properties(${name} PROPERTIES CUDA_STANDARD 17 CUDA_STANDARD_REQUIRED ON)
endfunction()
