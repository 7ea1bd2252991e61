// Objects of the core that several threads of Python may share.
#pragma once

#include <mutex>
#include <utility>

#include "arrays.h"

template <typename Object>
struct Shared : Object {
  using Object::Object;
  std::mutex busy;
};

// A method that one thread at a time is in: it may let go of Python's lock while it computes, and others wait for it without that lock.
template <typename Object, typename Result, typename... Arguments>
auto in_turn(Result (*method)(Object&, Arguments...)) {
  return [method](Object& object, Arguments... arguments) -> Result {
    std::unique_lock<std::mutex> turn(object.busy, std::try_to_lock);
    if (!turn) unlocked([&] { turn.lock(); });
    return method(object, std::forward<Arguments>(arguments)...);
  };
}
