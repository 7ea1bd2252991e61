// Objects of the core that several threads of Python may share.
#pragma once

#include "arrays.h"  // first: Python's header comes before the system's

#include <mutex>

template <typename Object>
struct Shared : Object {
  using Object::Object;
  std::mutex busy;
};

// While it lives no other thread has a turn; others wait for it without Python's lock.
struct Turn {
  std::unique_lock<std::mutex> alone;
  explicit Turn(std::mutex& busy) : alone(busy, std::try_to_lock) {
    if (!alone) unlocked([&] { alone.lock(); });
  }
};

// A function of an object that one thread at a time is in: it may let go of Python's lock while it computes.
template <typename Object, typename Result, typename... Arguments>
auto in_turn(Result (*function)(Object&, Arguments...)) {
  return [function](Object& object, Arguments... arguments) -> Result {
    const Turn turn(object.busy);
    return function(object, std::forward<Arguments>(arguments)...);
  };
}

// The same of a method that needs no Python; a short one keeps the lock.
enum class PythonLock { kKept, kReleased };
template <PythonLock kLock, typename Object, typename Result, typename... Arguments, typename Method>
auto method_in_turn(Method method) {
  return [method](Shared<Object>& object, Arguments... arguments) -> Result {
    const Turn turn(object.busy);
    const auto call = [&] { return (object.*method)(std::forward<Arguments>(arguments)...); };
    if constexpr (kLock == PythonLock::kReleased) return unlocked(call);
    const fleetmap::CountedStep counted;
    return call();
  };
}
template <PythonLock kLock = PythonLock::kKept, typename Object, typename Result, typename... Arguments>
auto in_turn(Result (Object::*method)(Arguments...)) {
  return method_in_turn<kLock, Object, std::decay_t<Result>, Arguments...>(method);
}
template <PythonLock kLock = PythonLock::kKept, typename Object, typename Result, typename... Arguments>
auto in_turn(Result (Object::*method)(Arguments...) const) {
  return method_in_turn<kLock, Object, std::decay_t<Result>, Arguments...>(method);
}
