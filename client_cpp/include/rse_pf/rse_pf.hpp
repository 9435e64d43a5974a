// Everything of the client; a program includes this file and links OpenSSL and a library of threads.
#pragma once

#include "robot.hpp"
#include "data.hpp"
