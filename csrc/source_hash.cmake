# Writes OUTPUT, a header with the SHA-256 of all sources of the core: of the lines "sha256  name" of each,
# in the order of their names, as `cd csrc && sha256sum *.c *.h | sort -k 2 | sha256sum` has them.
#   cmake -DSOURCES=... (semicolons) -DOUTPUT=... -P source_hash.cmake
set(names "")
foreach(source IN LISTS SOURCES)
  get_filename_component(name "${source}" NAME)
  file(SHA256 "${source}" one)
  list(APPEND names "${name}")
  set(hash_of_${name} "${one}")
endforeach()
list(SORT names)
set(lines "")
foreach(name IN LISTS names)
  string(APPEND lines "${hash_of_${name}}  ${name}\n")
endforeach()
string(SHA256 whole "${lines}")
file(WRITE "${OUTPUT}" "#define RTHYB_SOURCE_HASH \"${whole}\"\n")
