// A service as a C++17 class, on top of the C interface of rse_pf_service.h; header only.
//
//   #include "rse_pf_service.hpp"
//   struct Centroid {
//     rse_pf::Fields call(const rse_pf::Fields &request) {
//       const rse_pf::Field &points = request.at("points");
//       ...
//       rse_pf::Fields reply;
//       reply["centroid"] = rse_pf::Field::array(values, {3});
//       return reply;
//     }
//   };
//   RSE_PF_SERVICE(Centroid)
//
// Throw rse_pf::BadRequest, rse_pf::Degenerate or any std::exception to fail a request: the robot receives the error
// "bad-request", "degenerate" or "failed" with its text.
// The class needs a constructor without arguments.  The state of a class with `std::string snapshot() const` and
// `void restore(const std::string &)` survives its server: write RSE_PF_SERVICE_WITH_SNAPSHOTS(Class) instead.
#ifndef RSE_PF_SERVICE_HPP
#define RSE_PF_SERVICE_HPP

#include <cstdlib>
#include <cstring>
#include <exception>
#include <map>
#include <new>
#include <stdexcept>
#include <string>
#include <vector>

#include "rse_pf_service.h"

namespace rse_pf {

// The request is invalid; the robot receives the error "bad-request".
struct BadRequest : std::runtime_error {
  using std::runtime_error::runtime_error;
};

// The geometry of the request does not determine a result; the robot receives the error "degenerate".
struct Degenerate : std::runtime_error {
  using std::runtime_error::runtime_error;
};

// A value of a request or a reply: a number (one element in `values`, an empty `shape`), a text (in `text`), or an
// array of doubles (row-major in `values`, at most 4 axes in `shape`).
struct Field {
  uint32_t type = RSE_PF_FLOAT64;
  std::vector<uint64_t> shape;
  std::vector<double> values;
  std::string text;

  static Field number(double value) { return Field{RSE_PF_FLOAT64, {}, {value}, {}}; }
  static Field of_text(std::string value) { return Field{RSE_PF_TEXT, {}, {}, std::move(value)}; }
  static Field array(std::vector<double> values, std::vector<uint64_t> shape) {
    return Field{RSE_PF_FLOAT64, std::move(shape), std::move(values), {}};
  }
  // Return the number of a field with one number, also in an array; throw BadRequest for any other field.
  double as_number() const {
    if (type != RSE_PF_FLOAT64 || values.size() != 1) throw BadRequest("expected one number");
    return values[0];
  }
};

// The fields of a request or a reply by their names.
class Fields : public std::map<std::string, Field> {
 public:
  // Return the field `name`; throw BadRequest if the request has no such field.
  const Field &at(const std::string &name) const {
    auto found = find(name);
    if (found == end()) throw BadRequest("the request has no field '" + name + "'");
    return found->second;
  }
  // Return the numbers of the field `name`, row by row, whatever its shape; there may be none.  Throw BadRequest if the
  // field is missing, is a text, or the count of its numbers is not a multiple of `columns`.
  const std::vector<double> &rows(const std::string &name, std::size_t columns) const {
    const Field &field = at(name);
    if (field.type != RSE_PF_FLOAT64 || field.values.size() % columns != 0)
      throw BadRequest("field '" + name + "' must hold rows of " + std::to_string(columns) + " numbers");
    return field.values;
  }
};

namespace detail {

// What the C functions receive as their state: the service, and why its last call failed.
template <class Service>
struct State {
  Service service;
  std::string error;
};

// Return copies of the C fields of a request; of several fields with the same name the last one counts.
inline Fields copy_fields(const rse_pf_field *fields, uint32_t count) {
  Fields copies;
  for (uint32_t i = 0; i < count; ++i) {
    Field field;
    field.type = fields[i].type;
    field.shape.assign(fields[i].shape, fields[i].shape + fields[i].rank);
    if (field.type == RSE_PF_TEXT) {
      field.text.assign(static_cast<const char *>(fields[i].data), fields[i].count);
    } else {
      const double *data = static_cast<const double *>(fields[i].data);
      field.values.assign(data, data + fields[i].count);
    }
    copies[fields[i].name] = std::move(field);
  }
  return copies;
}

// Return a reply as C fields in one block of memory: the fields, then all numbers, then all names and texts.  free()
// releases the block.  Of a shape only the first 4 axes are kept; if they do not hold all numbers, the platform
// refuses the reply.
inline rse_pf_field *allocate_fields(const Fields &fields) {
  std::size_t numbers = 0, bytes = 0;
  for (const auto &entry : fields) {
    numbers += entry.second.values.size();
    bytes += entry.first.size() + 1 + entry.second.text.size();
  }
  std::size_t head = sizeof(rse_pf_field) * fields.size();
  char *block = static_cast<char *>(std::malloc(head + numbers * sizeof(double) + bytes + 1));
  if (block == nullptr) throw std::bad_alloc();
  rse_pf_field *out = reinterpret_cast<rse_pf_field *>(block);
  double *values = reinterpret_cast<double *>(block + head);
  char *text = block + head + numbers * sizeof(double);
  std::size_t i = 0;
  for (const auto &entry : fields) {
    const Field &field = entry.second;
    rse_pf_field c_field = {};
    c_field.type = field.type;
    c_field.rank = static_cast<uint32_t>(field.shape.size() > 4 ? 4 : field.shape.size());
    for (uint32_t axis = 0; axis < c_field.rank; ++axis) c_field.shape[axis] = field.shape[axis];
    c_field.name = text;
    std::memcpy(text, entry.first.c_str(), entry.first.size() + 1);
    text += entry.first.size() + 1;
    if (field.type == RSE_PF_TEXT) {
      c_field.count = field.text.size();
      c_field.data = text;
      std::memcpy(text, field.text.data(), field.text.size());
      text += field.text.size();
    } else {
      c_field.count = field.values.size();
      c_field.data = values;
      if (!field.values.empty()) std::memcpy(values, field.values.data(), field.values.size() * sizeof(double));
      values += field.values.size();
    }
    out[i++] = c_field;
  }
  return out;
}

// Run `work`, return a code of rse_pf_status, and set `error` to the message of the exception, empty after success.
template <class Work>
int run_guarded(std::string &error, Work work) {
  try {
    error.clear();
    work();
    return RSE_PF_OK;
  } catch (const BadRequest &thrown) {
    error = thrown.what();
    return RSE_PF_BAD_REQUEST;
  } catch (const Degenerate &thrown) {
    error = thrown.what();
    return RSE_PF_DEGENERATE;
  } catch (const std::exception &thrown) {
    error = thrown.what();
  } catch (...) {
    error = "an exception of an unknown type";
  }
  return RSE_PF_FAILED;
}

}  // namespace detail
}  // namespace rse_pf

// Define the functions of rse_pf_service.h for a class with `rse_pf::Fields call(const rse_pf::Fields &)`; write it
// once, in one source file, outside of any namespace.  After an exception of the constructor the robot receives the
// error that the service cannot be loaded, without the message of the exception.
#define RSE_PF_SERVICE(Class)                                                                                       \
  using RsePfState = rse_pf::detail::State<Class>;                                                                  \
  extern "C" RSE_PF_EXPORT uint32_t rse_pf_service_abi(void) { return RSE_PF_SERVICE_ABI; }                         \
  extern "C" RSE_PF_EXPORT int rse_pf_service_open(const char *, void **state) {                                    \
    std::string error;                                                                                              \
    return rse_pf::detail::run_guarded(error, [&] { *state = new RsePfState(); });                                  \
  }                                                                                                                 \
  extern "C" RSE_PF_EXPORT void rse_pf_service_close(void *state) { delete static_cast<RsePfState *>(state); }      \
  extern "C" RSE_PF_EXPORT const char *rse_pf_service_error(void *state) {                                          \
    return static_cast<RsePfState *>(state)->error.c_str();                                                         \
  }                                                                                                                 \
  extern "C" RSE_PF_EXPORT void rse_pf_service_free(void *, void *memory) { std::free(memory); }                    \
  extern "C" RSE_PF_EXPORT int rse_pf_service_call_arrays(void *state, const rse_pf_field *request, uint32_t count, \
                                                          rse_pf_field **reply, uint32_t *reply_count) {            \
    RsePfState *own = static_cast<RsePfState *>(state);                                                             \
    return rse_pf::detail::run_guarded(own->error, [&] {                                                            \
      rse_pf::Fields fields = own->service.call(rse_pf::detail::copy_fields(request, count));                       \
      *reply_count = static_cast<uint32_t>(fields.size());                                                          \
      *reply = rse_pf::detail::allocate_fields(fields);                                                             \
    });                                                                                                             \
  }

// Define what RSE_PF_SERVICE defines, and the functions that pass out and restore the state of the class.
#define RSE_PF_SERVICE_WITH_SNAPSHOTS(Class)                                                                        \
  RSE_PF_SERVICE(Class)                                                                                             \
  extern "C" RSE_PF_EXPORT int rse_pf_service_snapshot(void *state, uint8_t **data, uint64_t *size) {               \
    RsePfState *own = static_cast<RsePfState *>(state);                                                             \
    return rse_pf::detail::run_guarded(own->error, [&] {                                                            \
      std::string bytes = own->service.snapshot();                                                                  \
      *data = static_cast<uint8_t *>(std::malloc(bytes.size() + 1));                                                \
      if (*data == nullptr) throw std::bad_alloc();                                                                 \
      std::memcpy(*data, bytes.data(), bytes.size());                                                               \
      *size = bytes.size();                                                                                         \
    });                                                                                                             \
  }                                                                                                                 \
  extern "C" RSE_PF_EXPORT int rse_pf_service_restore(void *state, const uint8_t *data, uint64_t size) {            \
    RsePfState *own = static_cast<RsePfState *>(state);                                                             \
    return rse_pf::detail::run_guarded(                                                                             \
        own->error, [&] { own->service.restore(std::string(reinterpret_cast<const char *>(data), size)); });        \
  }

#endif
