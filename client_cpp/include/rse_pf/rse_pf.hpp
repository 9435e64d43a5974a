// All headers of the client. A program that includes this file links OpenSSL and a library of threads.
#pragma once

#include "robot.hpp"
#include "data.hpp"
